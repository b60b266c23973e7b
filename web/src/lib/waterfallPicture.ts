//! A spectrogram as a waterfall: spectra one before the other, the earliest behind.
import type { Schemas } from './api'
import { css, token, viridis } from './colour'
import { plain } from './format'
import { logTicks, ticks } from './plot'
import {
  beginPicture,
  frequencyAt,
  levelAt,
  SPECTROGRAM_PAD,
  SPECTROGRAM_RANGE_DB,
  SPECTROGRAM_ROWS,
  type SpectrogramAxes,
} from './spectrogramPicture'

/** Spectra that are drawn at most. */
const MOST_SPECTRA = 32
const PAD = SPECTROGRAM_PAD
/** Part of the width and of the height that the spectra move by. */
const SHIFT = { across: 0.16, down: 0.45 } as const

/** The times that are drawn: from the loudest to the last that is within the range below it. */
export function waterfallTimes(data: Schemas['Spectrogram']): number[] {
  let [loudest, last] = [0, 0]
  let highest = -Infinity
  for (let time = 0; time < data.times; time += 1) {
    const levels = data.level_db.slice(time * data.bins, (time + 1) * data.bins)
    const level = levels.reduce((most, one) => Math.max(most, one), -Infinity)
    if (level > highest) [loudest, highest] = [time, level]
    if (level > -SPECTROGRAM_RANGE_DB) last = time
  }
  const count = Math.max(1, Math.min(MOST_SPECTRA, last - loudest + 1))
  return Array.from({ length: count }, (_, i) => loudest + Math.round((i * (last - loudest)) / Math.max(1, count - 1)))
}

/** Draws the spectra, the frequencies below and the times beside them. */
export function drawWaterfall(
  canvas: HTMLCanvasElement,
  width: number,
  height: number,
  data: Schemas['Spectrogram'],
  axes: SpectrogramAxes,
): void {
  const context = beginPicture(canvas, width, height)
  if (!context) return
  const across = Math.max(10, width - PAD.left - PAD.right)
  const down = height - PAD.top - PAD.bottom
  const [long, tall] = [across * (1 - SHIFT.across), down * (1 - SHIFT.down)]
  const times = waterfallTimes(data)
  const shareOf = (i: number) => (times.length > 1 ? i / (times.length - 1) : 0)
  /** Left end of a spectrum's base line. */
  const corner = (i: number) => [
    PAD.left + across * SHIFT.across * (1 - shareOf(i)),
    PAD.top + tall + down * SHIFT.down * shareOf(i),
  ]
  for (const [i, time] of times.entries()) {
    const [left, base] = corner(i)
    context.beginPath()
    context.moveTo(left, base)
    for (let row = 0; row < SPECTROGRAM_ROWS; row += 1) {
      const share = row / (SPECTROGRAM_ROWS - 1)
      const level = levelAt(data, time, frequencyAt(axes, share))
      context.lineTo(left + long * share, base - tall * Math.max(0, 1 + level / SPECTROGRAM_RANGE_DB))
    }
    context.lineTo(left + long, base)
    context.fillStyle = token('--paper')
    context.fill()
    context.strokeStyle = css(viridis(0.85 * (1 - shareOf(i))))
    context.stroke()
  }
  context.font = '12px Plex, sans-serif'
  context.fillStyle = token('--ink')
  context.textBaseline = 'middle'
  context.textAlign = 'center'
  const [front, floor] = corner(times.length - 1)
  const [low_khz, high_khz] = [axes.low_hz / 1000, axes.high_hz / 1000]
  const place = (khz: number) =>
    axes.logarithmic ? Math.log(khz / low_khz) / Math.log(high_khz / low_khz) : (khz - low_khz) / (high_khz - low_khz)
  for (const tick of axes.logarithmic ? logTicks(low_khz, high_khz) : ticks(low_khz, high_khz, 5))
    context.fillText(plain(tick), front + long * place(tick), floor + 12)
  context.fillText('Frequency, kHz', front + long / 2, height - 8)
  context.textAlign = 'left'
  for (const i of new Set([0, Math.floor((times.length - 1) / 2), times.length - 1])) {
    const [left, base] = corner(i)
    context.fillText(`${plain(1000 * times[i] * data.step_s, 3)} ms`, left + long + 6, base)
  }
  context.textAlign = 'right'
  const [back, base] = corner(0)
  for (const level of [0, -SPECTROGRAM_RANGE_DB])
    context.fillText(`${plain(level)} dB`, back - 6, base - tall * (1 + level / SPECTROGRAM_RANGE_DB) + (level ? 0 : 6))
}
