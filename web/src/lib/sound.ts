//! Responses as sound.
import type { Lake } from './api'

const REPEATS = 3
const GAP_S = 0.35
const LOUDNESS = 0.7
let context: AudioContext | undefined

/** Models are played so many times slower as they are smaller; nothing is slowed down if the rig does not say its scale. */
export const slowdownOf = (lake: Lake) => lake.scale ?? 1

/** Sounds without a room, made by synthesis. */
export const DRY_SOUNDS = ['claps', 'plucked string', 'noise'] as const
export type DrySound = (typeof DRY_SOUNDS)[number]
const DRY_S = 2.4
const STEP_S = 0.6

/** A dry sound: claps are bursts of noise that fade in 10 ms, strings are by Karplus and Strong, noise is white. */
export function synthesiseSound(sound: DrySound, rate: number): Float32Array {
  let state = 1
  const noise = () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0
    return state / 2 ** 31 - 1
  }
  const step = Math.round(STEP_S * rate)
  const out = new Float32Array(Math.round(DRY_S * rate))
  if (sound === 'noise') return out.map((_, i) => (i % step < step / 2 ? noise() : 0))
  if (sound === 'claps') return out.map((_, i) => noise() * Math.exp(-(i % step) / (0.01 * rate)))
  for (let note = 0; note * step < out.length; note += 1) {
    const period = Math.round(rate / (220 * [1, 1.25, 1.5, 2][note % 4]))
    const string = Float32Array.from({ length: period }, noise)
    for (let i = 0; i < step; i += 1) {
      const at = i % period
      out[note * step + i] = string[at]
      string[at] = 0.498 * (string[at] + string[(at + 1) % period])
    }
  }
  return out
}

function convolve(dry: Float32Array, response: readonly number[]): Float32Array {
  const out = new Float32Array(dry.length + response.length - 1)
  for (let i = 0; i < dry.length; i += 1)
    if (dry[i] !== 0) for (let k = 0; k < response.length; k += 1) out[i + k] += dry[i] * response[k]
  return out
}

const energyOf = (signal: Float32Array) => signal.reduce((sum, x) => sum + x * x, 0)
const peakOf = (signal: Float32Array) => signal.reduce((most, x) => Math.max(most, Math.abs(x)), 0)

/** Plays a dry sound by one of several responses at full scale. All have one gain, or with `matched` one energy. */
export function playConvolved(
  lake: Lake,
  sound: DrySound,
  responses: readonly (readonly number[])[],
  which: number,
  matched: boolean,
  ended: () => void,
): string {
  const rate = Math.round(lake.rate_hz / slowdownOf(lake))
  const dry = synthesiseSound(sound, rate)
  const sounds = responses.map((response) => convolve(dry, response))
  const energies = sounds.map(energyOf)
  const gains = energies.map((energy) => (matched ? Math.sqrt(energies[0] / energy) : 1))
  const peak = Math.max(...sounds.map((one, i) => gains[i] * peakOf(one)))
  const gain = (LOUDNESS * gains[which]) / peak
  playSamples(
    sounds[which].map((x) => gain * x),
    rate,
    ended,
  )
  const level = 10 * Math.log10(energies[which] / energies[0])
  return which === 0 ? '' : `${level.toFixed(1)} dB over the surface${matched ? ', matched' : ''}`
}

function playSamples(samples: Float32Array, rate: number, ended: () => void) {
  context ??= new AudioContext()
  const buffer = context.createBuffer(1, samples.length, rate)
  buffer.getChannelData(0).set(samples)
  const source = context.createBufferSource()
  source.buffer = buffer
  source.connect(context.destination)
  source.onended = ended
  source.start()
}

/** Plays a response three times, brought to one loudness; returns what is heard. */
export function playResponse(lake: Lake, samples: ArrayLike<number>, rate_hz: number, ended: () => void): string {
  const slowdown = slowdownOf(lake)
  const rate = Math.round(rate_hz / slowdown)
  const gap = Math.round(rate * GAP_S)
  const out = new Float32Array((samples.length + gap) * REPEATS)
  let peak = 1e-12
  for (let i = 0; i < samples.length; i += 1) peak = Math.max(peak, Math.abs(samples[i]))
  for (let r = 0; r < REPEATS; r += 1)
    for (let i = 0; i < samples.length; i += 1) out[r * (samples.length + gap) + i] = (LOUDNESS * samples[i]) / peak
  playSamples(out, rate, ended)
  return `Played at ${rate} Hz${slowdown > 1 ? `, ${slowdown} times slower` : ''}, three times, brought to one loudness`
}
