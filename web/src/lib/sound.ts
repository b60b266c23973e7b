//! Responses as sound.
import type { Lake } from './api'

const REPEATS = 3
const GAP_S = 0.35
const LOUDNESS = 0.7
let context: AudioContext | undefined

/** Models at 1:10 are measured up to where nobody hears: they are played so many times slower. */
export const slowdownOf = (lake: Lake) => (lake.high_hz > 20_000 ? 10 : 1)

/** Plays a response three times, brought to one loudness; returns what is heard. */
export function playResponse(lake: Lake, samples: ArrayLike<number>, rate_hz: number, ended: () => void): string {
  const slowdown = slowdownOf(lake)
  const rate = Math.round(rate_hz / slowdown)
  context ??= new AudioContext()
  const gap = Math.round(rate * GAP_S)
  const buffer = context.createBuffer(1, (samples.length + gap) * REPEATS, rate)
  const out = buffer.getChannelData(0)
  let peak = 1e-12
  for (let i = 0; i < samples.length; i += 1) peak = Math.max(peak, Math.abs(samples[i]))
  for (let r = 0; r < REPEATS; r += 1)
    for (let i = 0; i < samples.length; i += 1) out[r * (samples.length + gap) + i] = (LOUDNESS * samples[i]) / peak
  const source = context.createBufferSource()
  source.buffer = buffer
  source.connect(context.destination)
  source.onended = ended
  source.start()
  return `Played at ${rate} Hz${slowdown > 1 ? `, ${slowdown} times slower` : ''}, three times, brought to one loudness`
}
