//! What is read off a response: its envelope, levels smoothed over frequency, phase and group delay.
import { atLeast, fft, transform } from './fourier'

/** Speed of sound at 0 °C, m/s, and 0 °C in K: as the server's `speed_of_sound`. */
const SPEED_AT_ZERO_M_S = 331.3
const ZERO_CELSIUS_K = 273.15

/** Time that sound takes for a path in air of a temperature. */
export const travelTime_s = (path_mm: number, temperature_c: number) =>
  path_mm / 1000 / (SPEED_AT_ZERO_M_S * Math.sqrt(1 + temperature_c / ZERO_CELSIUS_K))

/** Magnitude of the analytic signal: negative frequencies are set to zero, positive ones doubled. */
export function envelope(samples: readonly number[]): Float64Array {
  // Zeros keep the end of the response from wrapping around to its beginning.
  const n = atLeast(2 * samples.length)
  const { re, im } = transform(samples, n)
  // The inverse transform is the conjugate of the conjugate's transform, whose magnitude is the same.
  for (let k = 0; k < n; k += 1) {
    const weight = k === 0 || k === n / 2 ? 1 : k < n / 2 ? 2 : 0
    re[k] *= weight / n
    im[k] *= -weight / n
  }
  fft(re, im)
  return Float64Array.from(samples, (_, i) => Math.hypot(re[i], im[i]))
}

/** Highest value from `reach_s` before a time to as long after it. */
export function highestAround(values: ArrayLike<number>, rate_hz: number, time_s: number, reach_s: number): number {
  const first = Math.max(0, Math.round((time_s - reach_s) * rate_hz))
  const last = Math.min(values.length - 1, Math.round((time_s + reach_s) * rate_hz))
  let most = 0
  for (let i = first; i <= last; i += 1) most = Math.max(most, values[i])
  return most
}

/** Levels of magnitudes, dB re `reference`; null below `floor_db`, which keeps zeros off the plot. */
export const levels_db = (magnitudes: ArrayLike<number>, reference: number, floor_db = -120) =>
  Array.from(magnitudes, (value) => {
    const level = 20 * Math.log10(Math.abs(value) / reference)
    return level >= floor_db ? level : null
  })

/** Means of a spectrum's values over `octaves` around each bin, rectangular on a logarithmic axis; 0 octaves: as they are.
 *
 * values  [bins]  bin k at k times the first one's frequency; between two bins the values are linear over the logarithm
 */
export function smoothed(values: Float64Array, octaves: number): Float64Array {
  if (octaves === 0) return values
  const last = values.length - 1
  const sums = new Float64Array(last + 1)
  for (let k = 1; k < last; k += 1) sums[k + 1] = sums[k] + ((values[k] + values[k + 1]) / 2) * Math.log((k + 1) / k)
  const sumUpTo = (at: number) => {
    const k = Math.min(last - 1, Math.floor(at))
    const share = Math.log(at / k)
    return sums[k] + values[k] * share + ((values[k + 1] - values[k]) * share ** 2) / (2 * Math.log((k + 1) / k))
  }
  const half = 2 ** (octaves / 2)
  return values.map((value, k) => {
    const [low, high] = [Math.max(1, k / half), Math.min(last, k * half)]
    return low < high ? (sumUpTo(high) - sumUpTo(low)) / Math.log(high / low) : value
  })
}

/** A response over frequency; what not every page shows is computed when it is asked for. */
export interface FrequencyResponse {
  readonly frequency_hz: readonly number[]
  readonly level_db: readonly number[]
  /** Unwrapped upwards from the range's lowest frequency, after `removed_s` was taken off; not smoothed. */
  phase_deg(): number[]
  /** After the same delay; a mean by energy over the octaves. */
  groupDelay_s(): number[]
}

/** The range of frequencies, the smoothing of power, and the delay that is taken off phase and group delay. */
export interface AnalysisSettings {
  readonly low_hz: number
  readonly high_hz: number
  readonly octaves: number
  readonly removed_s: number
}

/** Level re 1, phase and group delay from the lowest to the highest frequency of the settings. */
export function frequencyResponse(
  samples: readonly number[],
  rate_hz: number,
  settings: AnalysisSettings,
): FrequencyResponse {
  // Four times the length: phase turns by a quarter of a circle at most from bin to bin.
  const n = atLeast(4 * samples.length)
  const own = transform(samples, n)
  const power = own.re.slice(0, n / 2 + 1).map((re, k) => re ** 2 + own.im[k] ** 2)
  const meanPower = smoothed(power, settings.octaves)
  const first = Math.max(1, Math.ceil((settings.low_hz * n) / rate_hz))
  const last = Math.min(n / 2, Math.floor((settings.high_hz * n) / rate_hz))
  const bins = Array.from({ length: last - first + 1 }, (_, i) => first + i)
  return {
    frequency_hz: bins.map((k) => (k * rate_hz) / n),
    level_db: bins.map((k) => 10 * Math.log10(meanPower[k] + 1e-20)),
    phase_deg() {
      const radians = (k: number) =>
        Math.atan2(own.im[k], own.re[k]) + (2 * Math.PI * k * settings.removed_s * rate_hz) / n
      return unwrapped(bins.map((k) => (radians(k) * 180) / Math.PI))
    },
    groupDelay_s() {
      const byTime = transform(
        samples.map((value, i) => (value * i) / rate_hz),
        n,
      )
      // It is the real part of the spectrum of t h(t) over that of h(t); here times the power.
      const delayed = power.map((_, k) => own.re[k] * byTime.re[k] + own.im[k] * byTime.im[k])
      const meanDelayed = smoothed(delayed, settings.octaves)
      return bins.map((k) => meanDelayed[k] / (meanPower[k] + 1e-30) - settings.removed_s)
    },
  }
}

/** Angles without jumps of more than half a circle, the first one within half a circle of zero. */
export function unwrapped(degrees: readonly number[]): number[] {
  let turns = degrees.length ? -360 * Math.round(degrees[0] / 360) : 0
  return degrees.map((angle, i) => {
    if (i > 0) turns -= 360 * Math.round((angle - degrees[i - 1]) / 360)
    return angle + turns
  })
}
