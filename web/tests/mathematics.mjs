//! The pages' mathematics against closed forms: `node tests/mathematics.mjs`. Vite compiles the sources, as for the pages.
import assert from 'node:assert/strict'
import { createServer } from 'vite'

const vite = await createServer({ server: { middlewareMode: true }, appType: 'custom', logLevel: 'error' })
const { spectrogram, spectrum } = await vite.ssrLoadModule('/src/lib/fourier.ts')
const { envelope, frequencyResponse, highestAround, levels_db, smoothed, travelTime_s, unwrapped } =
  await vite.ssrLoadModule('/src/lib/responseAnalysis.ts')

const RATE_HZ = 96_000
const SETTINGS = { low_hz: 2000, high_hz: 40_000, octaves: 0, removed_s: 0 }
const zeros = (length) => new Array(length).fill(0)
const impulse = (at, height = 1) => zeros(384).with(at, height)
const near = (actual, expected, tolerance, what) =>
  assert.ok(Math.abs(actual - expected) <= tolerance, `${what}: ${actual}, expected ${expected} ± ${tolerance}`)
const eachNear = (actual, expected, tolerance, what) =>
  actual.forEach((value, i) => near(value, expected(i), tolerance, `${what} ${i}`))
function check(name, what) {
  what()
  process.stdout.write(`ok ${name}\n`)
}

check('an impulse has a flat level, also smoothed, and its delay as group delay', () => {
  for (const octaves of [0, 1 / 12, 1 / 6, 1 / 3, 1]) {
    const response = frequencyResponse(impulse(59, 0.5), RATE_HZ, { ...SETTINGS, octaves })
    eachNear(response.level_db, () => 20 * Math.log10(0.5), 1e-9, `level over ${octaves} octaves`)
    eachNear(response.groupDelay_s(), () => 59 / RATE_HZ, 1e-12, `group delay over ${octaves} octaves`)
    near(response.frequency_hz[0], 2000, RATE_HZ / 2048, 'lowest frequency')
    near(response.frequency_hz.at(-1), 40_000, RATE_HZ / 2048, 'highest frequency')
  }
  eachNear(spectrum(impulse(100), RATE_HZ).level_db, () => 0, 1e-9, 'level')
})

check('phase without its delay is zero, with it a straight line, and half a circle for an impulse below zero', () => {
  const removed_s = 59 / RATE_HZ
  const still = frequencyResponse(impulse(59), RATE_HZ, { ...SETTINGS, removed_s })
  eachNear(still.phase_deg(), () => 0, 1e-6, 'phase')
  eachNear(still.groupDelay_s(), () => 0, 1e-12, 'group delay')
  const moving = frequencyResponse(impulse(62), RATE_HZ, { ...SETTINGS, removed_s })
  eachNear(moving.phase_deg(), (i) => (-360 * moving.frequency_hz[i] * 3) / RATE_HZ, 1e-6, 'phase of three samples')
  const below = frequencyResponse(impulse(59, -1), RATE_HZ, { ...SETTINGS, removed_s })
  eachNear(below.phase_deg().map(Math.abs), () => 180, 1e-6, 'phase below zero')
})

check('two impulses make a comb, whose group delay between its notches is the mean by pressure', () => {
  const samples = impulse(40).with(60, 0.5)
  const { frequency_hz, level_db, groupDelay_s } = frequencyResponse(samples, RATE_HZ, SETTINGS)
  const delays_s = groupDelay_s()
  frequency_hz.forEach((frequency, i) => {
    const angle = (2 * Math.PI * frequency * 20) / RATE_HZ
    near(level_db[i], 10 * Math.log10(1.25 + Math.cos(angle)), 1e-9, `level at ${frequency} Hz`)
    const late = (0.25 + 0.5 * Math.cos(angle)) / (1.25 + Math.cos(angle))
    near(delays_s[i], (40 + 20 * late) / RATE_HZ, 1e-12, `group delay at ${frequency} Hz`)
  })
})

check('smoothing a power that grows with frequency gives its mean over the logarithm', () => {
  const power = Float64Array.from({ length: 2049 }, (_, k) => k)
  for (const octaves of [1 / 12, 1 / 3, 1]) {
    const half = 2 ** (octaves / 2)
    const means = smoothed(power, octaves)
    // Between bins it is linear over the logarithm: 1/8k of the width off.
    for (let k = 40; k < 1400; k += 1)
      near(means[k] / k, (half - 1 / half) / (octaves * Math.LN2), 1e-4, `bin ${k} over ${octaves} octaves`)
  }
  assert.equal(smoothed(power, 0), power, 'nothing is smoothed over no octaves')
})

check('the envelope of a burst is its Gaussian, whatever the carrier’s phase', () => {
  const gauss = (i) => Math.exp(-(((i - 150) / 20) ** 2))
  for (const phase of [0, 1, 2]) {
    const burst = zeros(384).map((_, i) => gauss(i) * Math.cos((2 * Math.PI * 12_000 * i) / RATE_HZ + phase))
    const found = envelope(burst)
    eachNear([...found], gauss, 1e-5, 'envelope at')
    near(highestAround(found, RATE_HZ, 150 / RATE_HZ, 1e-4), 1, 1e-5, 'highest')
    near(highestAround(found, RATE_HZ, 110 / RATE_HZ, 1e-4), gauss(120), 1e-5, 'highest of a part')
  }
})

check('levels, angles and travel times', () => {
  assert.deepEqual(levels_db([1, -0.1, 0, 1e-9], 0.1), [20, 0, null, null])
  assert.deepEqual(unwrapped([350, 10, 200, -170]), [-10, 10, -160, -170])
  assert.deepEqual(unwrapped([]), [])
  near(travelTime_s(343.2, 20), 1e-3, 2e-7, '343.2 mm at 20 °C')
})

check('the spectrogram of a tone is highest at its time and frequency', () => {
  const tone = zeros(384).map((_, i) => (Math.abs(i - 200) < 60 ? Math.sin((2 * Math.PI * 15_000 * i) / RATE_HZ) : 0))
  const { bins, bin_hz, step_s, level_db } = spectrogram(tone, RATE_HZ)
  const highest = level_db.reduce((best, level, i) => (level > level_db[best] ? i : best), 0)
  near((highest % bins) * bin_hz, 15_000, bin_hz, 'frequency')
  near(Math.floor(highest / bins) * step_s, 200 / RATE_HZ, 60 / RATE_HZ, 'time')
})

await vite.close()
