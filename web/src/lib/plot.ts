//! What a line plot shows; drawn on screen by Plot.svelte and on paper by plotSvg.ts.

export interface Axis {
  readonly label: string
  readonly unit: string
  readonly low?: number
  readonly high?: number
  readonly log?: boolean
}
export interface Line {
  readonly label: string
  /** null leaves a gap; a line goes on over what is undefined. */
  readonly values: readonly (number | null | undefined)[]
  /** Name of a colour token. */
  readonly colour: string
  readonly width?: number
  readonly dash?: readonly number[]
  /** Points instead of a line. */
  readonly dots?: boolean
  /** Fills down to zero, or to the line of this number. */
  readonly fillTo?: number | 'zero'
  /** What the legend shows instead of `values`: the parts of a stack. */
  readonly parts?: readonly number[]
}
export interface PlotSpec {
  readonly x: Axis & { readonly values: readonly number[] }
  readonly y: Axis
  readonly lines: readonly Line[]
  readonly mark?: number
}
export interface TableData {
  readonly columns: readonly string[]
  readonly rows: readonly (readonly (string | number | boolean | null)[])[]
}

/** An axis as it is written beside it. */
export const axisTitle = (axis: Axis) => (axis.unit ? `${axis.label}, ${axis.unit}` : axis.label)

/** Whether values make a line that shows something: they change. */
export const isSeries = (values: readonly (number | null)[]) =>
  new Set(values.filter((value) => value !== null)).size > 1

/** The plot's numbers as a table. */
export function tableOf(spec: PlotSpec): TableData {
  return {
    columns: [axisTitle(spec.x), ...spec.lines.map((line) => axisTitle({ label: line.label, unit: spec.y.unit }))],
    rows: spec.x.values.map((x, i) => [x, ...spec.lines.map((line) => line.parts?.[i] ?? line.values[i] ?? null)]),
  }
}

/** Low and high of the y axis, with a little air. */
export function yRange(spec: PlotSpec): [number, number] {
  let [low, high] = [Infinity, -Infinity]
  for (const line of spec.lines) {
    for (const value of line.values) {
      if (value === null || value === undefined || !Number.isFinite(value)) continue
      if (value < low) low = value
      if (value > high) high = value
    }
    if (line.fillTo === 'zero') low = Math.min(low, 0)
  }
  if (low > high) [low, high] = [0, 1]
  const air = (high - low || Math.abs(high) || 1) * 0.05
  return [spec.y.low ?? (low === 0 ? 0 : low - air), spec.y.high ?? high + air]
}

/** Numbers for a logarithmic axis: 1, 2, 5 in each decade, or round ones if the range has too few of them. */
export function logTicks(low: number, high: number): number[] {
  const found: number[] = []
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1)
    for (const m of [1, 2, 5]) {
      const value = Number((m * 10 ** power).toPrecision(3))
      if (value >= low * 0.999 && value <= high * 1.001) found.push(value)
    }
  return found.length >= 3 ? found : ticks(low, high, 5)
}

/** As many decimals as steps of this size need. */
export const decimals = (step: number) => Math.max(0, Math.ceil(-Math.log10(step) - 1e-9))

/** Round numbers across a range. */
export function ticks(low: number, high: number, about: number): number[] {
  const raw = (high - low) / Math.max(1, about)
  const power = 10 ** Math.floor(Math.log10(raw))
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw) ?? power
  const first = Math.ceil(low / step - 1e-9)
  const last = Math.floor(high / step + 1e-9)
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)))
}
