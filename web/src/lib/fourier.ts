//! Spectra of short responses.

/** Radix-2 transform in place; lengths are powers of two. */
export function fft(re: Float64Array, im: Float64Array): void {
  const n = re.length
  for (let i = 1, j = 0; i < n; i += 1) {
    let bit = n >> 1
    for (; j & bit; bit >>= 1) j ^= bit
    j ^= bit
    if (i < j) {
      ;[re[i], re[j]] = [re[j], re[i]]
      ;[im[i], im[j]] = [im[j], im[i]]
    }
  }
  for (let size = 2; size <= n; size <<= 1) {
    const half = size / 2
    for (let k = 0; k < half; k += 1) {
      const angle = (-2 * Math.PI * k) / size
      const [c, s] = [Math.cos(angle), Math.sin(angle)]
      for (let at = k; at < n; at += size) {
        const [xr, xi] = [re[at + half] * c - im[at + half] * s, re[at + half] * s + im[at + half] * c]
        re[at + half] = re[at] - xr
        im[at + half] = im[at] - xi
        re[at] += xr
        im[at] += xi
      }
    }
  }
}

const atLeast = (n: number) => 2 ** Math.ceil(Math.log2(Math.max(2, n)))
const level = (re: number, im: number) => 10 * Math.log10(re * re + im * im + 1e-20)

/** Magnitudes in dB re 1 up to half the rate; zeros are appended until there are at least 1024 samples. */
export function spectrum(samples: readonly number[], rate_hz: number): { frequency_hz: number[]; level_db: number[] } {
  const n = atLeast(Math.max(1024, samples.length))
  const re = new Float64Array(n)
  re.set(samples)
  const im = new Float64Array(n)
  fft(re, im)
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
  for (let t = 0; t < times; t += 1) {
    const re = new Float64Array(n)
    const im = new Float64Array(n)
    for (let i = 0; i < window; i += 1) {
      const at = t * step + i - window / 2
      if (at >= 0 && at < samples.length)
        re[i] = samples[at] * (0.5 - 0.5 * Math.cos((2 * Math.PI * (i + 0.5)) / window))
    }
    fft(re, im)
    for (let k = 0; k < bins; k += 1) level_db[t * bins + k] = level(re[k], im[k])
  }
  return { times, bins, step_s: step / rate_hz, bin_hz: rate_hz / n, level_db }
}
