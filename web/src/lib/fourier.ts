//! Spectra of short responses.

/** cos and sin of the fractions of a circle that a transform turns by, by its length. */
const circles = new Map<number, { readonly cos: Float64Array; readonly sin: Float64Array }>()

function circleOf(n: number) {
  let circle = circles.get(n)
  if (!circle) {
    const angles = Float64Array.from({ length: n / 2 }, (_, k) => (-2 * Math.PI * k) / n)
    circle = { cos: angles.map(Math.cos), sin: angles.map(Math.sin) }
    circles.set(n, circle)
  }
  return circle
}

/** Radix-2 transform in place; lengths are powers of two. */
export function fft(re: Float64Array, im: Float64Array): void {
  const n = re.length
  for (let i = 1, j = 0; i < n; i += 1) {
    let bit = n >> 1
    for (; j & bit; bit >>= 1) j ^= bit
    j ^= bit
    if (i < j) {
      const [r, m] = [re[i], im[i]]
      re[i] = re[j]
      im[i] = im[j]
      re[j] = r
      im[j] = m
    }
  }
  const { cos, sin } = circleOf(n)
  for (let size = 2; size <= n; size <<= 1) {
    const half = size / 2
    const stride = n / size
    for (let block = 0; block < n; block += size) {
      for (let k = 0; k < half; k += 1) {
        const at = block + k
        const c = cos[k * stride]
        const s = sin[k * stride]
        const xr = re[at + half] * c - im[at + half] * s
        const xi = re[at + half] * s + im[at + half] * c
        re[at + half] = re[at] - xr
        im[at + half] = im[at] - xi
        re[at] += xr
        im[at] += xi
      }
    }
  }
}

/** The power of two that is no less. */
export const atLeast = (n: number) => 2 ** Math.ceil(Math.log2(Math.max(2, n)))
const level = (re: number, im: number) => 10 * Math.log10(re * re + im * im + 1e-20)

/** A complex spectrum of `re.length` bins, the negative frequencies last. */
export interface ComplexSpectrum {
  readonly re: Float64Array
  readonly im: Float64Array
}

/** Transforms real samples, with zeros appended up to `length`, which is a power of two. */
export function transform(samples: ArrayLike<number>, length: number): ComplexSpectrum {
  const re = new Float64Array(length)
  re.set(samples)
  const im = new Float64Array(length)
  fft(re, im)
  return { re, im }
}

/** Magnitudes in dB re 1 up to half the rate; zeros are appended until there are at least 1024 samples. */
export function spectrum(samples: readonly number[], rate_hz: number): { frequency_hz: number[]; level_db: number[] } {
  const n = atLeast(Math.max(1024, samples.length))
  const { re, im } = transform(samples, n)
  const bins = Array.from({ length: n / 2 + 1 }, (_, k) => k)
  return { frequency_hz: bins.map((k) => (k * rate_hz) / n), level_db: bins.map((k) => level(re[k], im[k])) }
}

export interface Spectrogram {
  readonly times: number
  readonly bins: number
  readonly step_s: number
  readonly bin_hz: number
  readonly level_db: Float32Array
}

/** Hann windows of `window` samples, `step` apart, padded to 256; by time, then by frequency. */
export function spectrogram(samples: readonly number[], rate_hz: number, window = 48, step = 2): Spectrogram {
  const n = atLeast(Math.max(256, window))
  const bins = n / 2 + 1
  const times = Math.max(1, Math.ceil(samples.length / step))
  const level_db = new Float32Array(times * bins)
  const hann = Float64Array.from({ length: window }, (_, i) => 0.5 - 0.5 * Math.cos((2 * Math.PI * (i + 0.5)) / window))
  const re = new Float64Array(n)
  const im = new Float64Array(n)
  for (let t = 0; t < times; t += 1) {
    re.fill(0)
    im.fill(0)
    for (let i = 0; i < window; i += 1) {
      const at = t * step + i - window / 2
      if (at >= 0 && at < samples.length) re[i] = samples[at] * hann[i]
    }
    fft(re, im)
    for (let k = 0; k < bins; k += 1) level_db[t * bins + k] = level(re[k], im[k])
  }
  return { times, bins, step_s: step / rate_hz, bin_hz: rate_hz / n, level_db }
}
