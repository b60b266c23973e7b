//! A run along its time: the measurements in their order, breaks between them, and blocks of responses and poses.
import { sql, type RunDetail } from './api'
import { quoted } from './queries'

/** The measurements of a run in the order of time, column by column. */
export interface RunCourse {
  readonly pair_id: readonly number[]
  readonly microphone: readonly number[]
  readonly speaker: readonly number[]
  readonly attempt: readonly number[]
  readonly verdict: readonly string[]
  readonly log_time_ns: readonly number[]
  readonly snr_db: readonly (number | null)[]
  readonly temperature_c: readonly (number | null)[]
  readonly humidity_pct: readonly (number | null)[]
  readonly pressure_hpa: readonly (number | null)[]
}

/** A pose of one frame in another, as /tf has them: m, and a quaternion. */
export interface FramePose {
  readonly parent_frame_id: string
  readonly child_frame_id: string
  readonly translation: { readonly x: number; readonly y: number; readonly z: number }
  readonly rotation: { readonly x: number; readonly y: number; readonly z: number; readonly w: number }
}
export interface ReplayFrame {
  readonly pair_id: number
  readonly attempt: number
  readonly ir: readonly number[]
  /** Poses of both arms; null where the run has none. */
  readonly transforms: readonly FramePose[] | null
}

/** A time between two measurements that is so much longer than the others. */
export interface RunBreak {
  readonly from_s: number
  readonly to_s: number
}

const COLUMNS = [
  'pair_id',
  'microphone',
  'speaker',
  'attempt',
  'verdict',
  'log_time_ns',
  'snr_db',
  'temperature_c',
  'humidity_pct',
  'pressure_hpa',
] as const

/** The measurements, one a row. */
export const courseQuery = (run: string) =>
  `select log_time, ${COLUMNS.filter((name) => name !== 'log_time_ns').join(', ')}\nfrom measurements\nwhere run_id = ${quoted(run)}\norder by log_time_ns`

async function rowsOf<T>(query: string): Promise<T[]> {
  return (await sql(query, 'application/json')).json() as Promise<T[]>
}

/** Reads all measurements of a run by one request, without their responses. */
export async function readCourse(run: string): Promise<RunCourse> {
  const lists = COLUMNS.map((name) => `array_agg(${name} order by log_time_ns) as ${name}`)
  const [found] = await rowsOf<{ [K in keyof RunCourse]: RunCourse[K] | null }>(
    `select ${lists.join(', ')} from measurements where run_id = ${quoted(run)}`,
  )
  return Object.fromEntries(COLUMNS.map((name) => [name, found?.[name] ?? []])) as unknown as RunCourse
}

/** Samples that a block of responses holds, about: 100 to 200 kB of text. */
const BLOCK_SAMPLES = 12_288
const MOST_IN_BLOCK = 32

/** Room around a time in ns, which a number holds to 256 ns. */
const MARGIN_NS = 1_000_000

const MOST_BLOCKS = 24

/** Responses and, where the run has them, poses of a run's measurements, read in blocks. The oldest blocks are dropped. */
export class ReplayFrames {
  readonly size: number
  readonly #blocks = new Map<number, Promise<void>>()
  readonly #frames = new Map<string, ReplayFrame>()
  readonly #run: string
  readonly #course: RunCourse
  readonly #hasPoses: boolean

  constructor(run: string, course: RunCourse, ir_length: number, hasPoses: boolean) {
    this.#run = run
    this.#course = course
    this.#hasPoses = hasPoses
    this.size = Math.max(1, Math.min(MOST_IN_BLOCK, Math.floor(BLOCK_SAMPLES / ir_length)))
  }

  /** The frame of a measurement, if it is here. */
  at(i: number): ReplayFrame | undefined {
    return this.#frames.get(`${this.#course.pair_id[i]}/${this.#course.attempt[i]}`)
  }

  /** Reads a block unless it is here or on its way. */
  load(block: number): Promise<void> {
    const times = this.#course.log_time_ns.slice(block * this.size, (block + 1) * this.size)
    const found = this.#blocks.get(block)
    if (found || !times.length) return found ?? Promise.resolve()
    const answer = this.#read(times[0], times[times.length - 1])
    this.#blocks.set(block, answer)
    answer.catch(() => this.#blocks.delete(block))
    for (const old of [...this.#blocks.keys()].slice(0, -MOST_BLOCKS)) this.#blocks.delete(old)
    return answer
  }

  async #read(from_ns: number, to_ns: number): Promise<void> {
    const run = quoted(this.#run)
    const poses = this.#hasPoses ? `left join mcap(${run}, '/tf') t on t.log_time_ns = m.log_time_ns ` : ''
    const found = await rowsOf<ReplayFrame>(
      `select m.pair_id, m.attempt, m.ir, ${this.#hasPoses ? 't.transforms' : 'null as transforms'} from measurements m ${poses}where m.run_id = ${run} and m.log_time_ns between ${from_ns - MARGIN_NS} and ${to_ns + MARGIN_NS}`,
    )
    for (const one of found) this.#frames.set(`${one.pair_id}/${one.attempt}`, one)
    for (const old of [...this.#frames.keys()].slice(0, -MOST_BLOCKS * this.size)) this.#frames.delete(old)
  }
}

/** A pause is a break if it is so many times as long as half of all pauses at most. */
const BREAK_FACTOR = 5

/** Breaks of a run, by the times of its measurements. */
export function findBreaks(times_s: readonly number[]): RunBreak[] {
  const pauses = times_s.slice(1).map((time, i) => time - times_s[i])
  const middle = [...pauses].sort((a, b) => a - b)[Math.floor(pauses.length / 2)]
  return pauses.flatMap((pause, i) =>
    pause > BREAK_FACTOR * middle ? [{ from_s: times_s[i], to_s: times_s[i + 1] }] : [],
  )
}

/** The index of the last time that is not later; 0 before the first. */
export function indexAt(times_s: readonly number[], time_s: number): number {
  let [low, high] = [0, times_s.length]
  while (low < high) {
    const middle = (low + high) >> 1
    if (times_s[middle] <= time_s) low = middle + 1
    else high = middle
  }
  return Math.max(0, low - 1)
}

/** Warnings and errors of a run's log, s since its start. */
export const warningsOf = (detail: RunDetail) =>
  detail.events
    .filter((event) => event.level !== 'info')
    .map((event) => ({
      time_s: (Date.parse(event.log_time) - Date.parse(detail.run.started)) / 1000,
      message: event.message,
    }))

/** A time since the start as `1:02:03`. */
export function clock(time_s: number): string {
  const whole = Math.max(0, Math.floor(time_s + 1e-6))
  const parts = [Math.floor(whole / 60) % 60, whole % 60].map((part) => String(part).padStart(2, '0'))
  return `${Math.floor(whole / 3600)}:${parts.join(':')}`
}
