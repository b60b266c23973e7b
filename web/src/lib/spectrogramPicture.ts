//! A spectrogram as a picture.
import type { Schemas } from './api'
import { css, token, viridis } from './colour'
import { plain } from './format'
import { logTicks, ticks } from './plot'

/** What the colours show below the highest level. */
export const SPECTROGRAM_RANGE_DB = 50
/** Rows of the picture, lowest frequency first: each has one frequency. */
export const SPECTROGRAM_ROWS = 129
export const SPECTROGRAM_PAD = { left: 52, right: 64, top: 10, bottom: 40 } as const

type Spectrogram = Schemas['Spectrogram']

/** The axes of a spectrogram. */
export interface SpectrogramAxes {
  readonly logarithmic: boolean
  readonly low_hz: number
  readonly high_hz: number
  readonly length_s: number
  /** Frequencies between which the measurement is valid. */
  readonly valid_hz: readonly [number, number]
}

/** The frequency at a share of the axis' height, 0 to 1 upwards, and back. */
export const frequencyAt = (axes: SpectrogramAxes, share: number) =>
  axes.logarithmic
    ? axes.low_hz * (axes.high_hz / axes.low_hz) ** share
    : axes.low_hz + (axes.high_hz - axes.low_hz) * share
const shareOf = (axes: SpectrogramAxes, frequency_hz: number) =>
  axes.logarithmic
    ? Math.log(frequency_hz / axes.low_hz) / Math.log(axes.high_hz / axes.low_hz)
    : (frequency_hz - axes.low_hz) / (axes.high_hz - axes.low_hz)

/** The level below the highest at a step of time, between its bins linear. */
export function levelAt(data: Spectrogram, time: number, frequency_hz: number): number {
  const bin = Math.min(data.bins - 1, frequency_hz / data.bin_hz)
  const below = Math.min(data.bins - 2, Math.floor(bin))
  const low = data.level_db[time * data.bins + below]
  const high = data.level_db[time * data.bins + below + 1]
  return low + (high - low) * (bin - below)
}

/** Sizes a canvas to the screen's pixels and fills it with paper; null if it cannot be drawn on. */
export function beginPicture(
  canvas: HTMLCanvasElement,
  width: number,
  height: number,
): CanvasRenderingContext2D | null {
  const context = canvas.getContext('2d')
  if (!context) return null
  const ratio = devicePixelRatio || 1
  canvas.width = Math.round(width * ratio)
  canvas.height = Math.round(height * ratio)
  context.setTransform(ratio, 0, 0, ratio, 0, 0)
  context.fillStyle = token('--paper')
  context.fillRect(0, 0, width, height)
  return context
}

/** Draws levels as colours, axes and colour key. */
export function drawSpectrogram(
  canvas: HTMLCanvasElement,
  width: number,
  height: number,
  data: Spectrogram,
  axes: SpectrogramAxes,
): void {
  const context = beginPicture(canvas, width, height)
  if (!context) return
  const ink = token('--ink')
  const inner = {
    width: Math.max(10, width - SPECTROGRAM_PAD.left - SPECTROGRAM_PAD.right),
    height: height - SPECTROGRAM_PAD.top - SPECTROGRAM_PAD.bottom,
  }
  const x = (time_s: number) => SPECTROGRAM_PAD.left + (inner.width * time_s) / axes.length_s
  const y = (frequency_hz: number) => SPECTROGRAM_PAD.top + inner.height * (1 - shareOf(axes, frequency_hz))
  context.drawImage(colourImage(data, axes), SPECTROGRAM_PAD.left, SPECTROGRAM_PAD.top, inner.width, inner.height)
  context.strokeStyle = '#ffffffb0'
  context.setLineDash([4, 4])
  for (const limit of axes.valid_hz) {
    if (limit <= axes.low_hz || limit >= axes.high_hz) continue
    context.beginPath()
    context.moveTo(SPECTROGRAM_PAD.left, y(limit))
    context.lineTo(SPECTROGRAM_PAD.left + inner.width, y(limit))
    context.stroke()
  }
  context.setLineDash([])
  context.font = '12px Plex, sans-serif'
  context.fillStyle = ink
  context.textBaseline = 'middle'
  context.textAlign = 'right'
  const [low_khz, high_khz] = [axes.low_hz / 1000, axes.high_hz / 1000]
  for (const tick of axes.logarithmic ? logTicks(low_khz, high_khz) : ticks(low_khz, high_khz, 5))
    context.fillText(plain(tick), SPECTROGRAM_PAD.left - 6, y(1000 * tick))
  context.textAlign = 'center'
  for (const tick of ticks(0, axes.length_s * 1000, Math.max(3, inner.width / 90)))
    context.fillText(plain(tick), x(tick / 1000), SPECTROGRAM_PAD.top + inner.height + 12)
  context.fillText('Time, ms', SPECTROGRAM_PAD.left + inner.width / 2, height - 8)
  context.save()
  context.translate(10, SPECTROGRAM_PAD.top + inner.height / 2)
  context.rotate(-Math.PI / 2)
  context.fillText('Frequency, kHz', 0, 0)
  context.restore()
  const key = SPECTROGRAM_PAD.left + inner.width + 12
  for (let i = 0; i < inner.height; i += 1) {
    context.fillStyle = css(viridis(1 - i / inner.height))
    context.fillRect(key, SPECTROGRAM_PAD.top + i, 10, 1.5)
  }
  context.fillStyle = ink
  context.textAlign = 'left'
  for (const level of [0, -20, -40])
    context.fillText(
      `${plain(level)}${level === 0 ? ' dB' : ''}`,
      key + 14,
      SPECTROGRAM_PAD.top + 5 - (inner.height * level) / SPECTROGRAM_RANGE_DB,
    )
}

/** Colours by level, as pixels: red, green, blue and opacity, one byte each. */
const SHADES = 256
const shades = Array.from({ length: SHADES }, (_, i) => [...viridis(i / (SHADES - 1)), 255])
const palette = new Uint32Array(Uint8ClampedArray.from(shades.flat()).buffer)

/** One pixel a step of time and row. */
function colourImage(data: Spectrogram, axes: SpectrogramAxes): HTMLCanvasElement {
  const small = document.createElement('canvas')
  small.width = data.times
  small.height = SPECTROGRAM_ROWS
  const context = small.getContext('2d')
  if (!context) return small
  const image = context.createImageData(data.times, SPECTROGRAM_ROWS)
  const pixels = new Uint32Array(image.data.buffer)
  for (let row = 0; row < SPECTROGRAM_ROWS; row += 1) {
    const frequency_hz = frequencyAt(axes, row / (SPECTROGRAM_ROWS - 1))
    const first = (SPECTROGRAM_ROWS - 1 - row) * data.times
    for (let time = 0; time < data.times; time += 1) {
      const share = 1 + levelAt(data, time, frequency_hz) / SPECTROGRAM_RANGE_DB
      pixels[first + time] = palette[Math.round(Math.max(0, Math.min(1, share)) * (SHADES - 1))]
    }
  }
  context.putImageData(image, 0, 0)
  return small
}
