//! Pictures as SVG text, for export. Everything that comes from the lake goes through `escape`.
import { token } from './colour'
import { plain } from './format'
import { axisTitle, logTicks, ticks, yRange, type Line, type PlotSpec } from './plot'

export const escape = (text: string) => text.replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`)

const FONT = 'font-family="\'IBM Plex Sans\',\'Helvetica Neue\',Arial,sans-serif" font-size="12"'

/** A whole picture on the page's paper. */
export const picture = (width: number, height: number, body: string) =>
  `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" ${FONT}><rect width="100%" height="100%" fill="${token('--paper')}"/>${body}</svg>`

export const label = (x: number, y: number, text: string, anchor = 'start', extra = '') =>
  `<text x="${x}" y="${y}" text-anchor="${anchor}" fill="${token('--ink')}" ${extra}>${escape(text)}</text>`

const LEGEND_ROW = 18
const dashes = (line: Line) => (line.dash ? ` stroke-dasharray="${line.dash.join(' ')}"` : '')

/** The lines' places in the legend, in as many rows as they need. */
function legendEntries(spec: PlotSpec, left: number, right: number) {
  let [x, row] = [left, 0]
  return spec.lines.map((line) => {
    const wide = 44 + line.label.length * 6.6
    if (x > left && x + wide > right) {
      x = left
      row += 1
    }
    x += wide
    return { line, x: x - wide, row }
  })
}

/** A line plot. */
export function plotSvg(spec: PlotSpec, title: string, width = 720, height = 400): string {
  const [left, right, bottom] = [64, 16, 46]
  const entries = legendEntries(spec, left, width - right)
  const top = 56 + LEGEND_ROW * (entries.at(-1)?.row ?? 0)
  const [y0, y1] = yRange(spec)
  const xs = spec.x.values
  const [x0, x1] = [spec.x.low ?? xs[0], spec.x.high ?? xs[xs.length - 1]]
  const across = (v: number) => (spec.x.log ? Math.log(v / x0) / Math.log(x1 / x0) : (v - x0) / (x1 - x0))
  const px = (v: number) => left + across(v) * (width - left - right)
  const py = (v: number) => height - bottom - ((v - y0) / (y1 - y0)) * (height - top - bottom)
  const within = xs.map((x) => x >= x0 && x <= x1)
  const points = (values: readonly (number | null)[]) => stretches(values).flat()
  /** Points without a gap between them. */
  function stretches(values: readonly (number | null)[]): string[][] {
    const found: string[][] = [[]]
    values.forEach((v, i) => {
      if (v === null) found.push([])
      else if (within[i])
        found[found.length - 1].push(`${px(xs[i]).toFixed(2)},${py(Math.max(y0, Math.min(y1, v))).toFixed(2)}`)
    })
    return found.filter((one) => one.length)
  }
  const grid = token('--rule')
  let body = label(left, 20, title, 'start', 'font-weight="600"')
  for (const t of ticks(y0, y1, 6))
    body +=
      `<path d="M${left} ${py(t)}H${width - right}" stroke="${grid}"/>` + label(left - 6, py(t) + 4, plain(t), 'end')
  const xTicks = spec.x.log ? logTicks(x0, x1) : ticks(x0, x1, 8)
  for (const t of xTicks)
    body +=
      `<path d="M${px(t)} ${top}V${height - bottom}" stroke="${grid}"/>` +
      label(px(t), height - bottom + 16, plain(t), 'middle')
  spec.lines.forEach((line) => {
    const colour = token(line.colour)
    if (line.fillTo !== undefined) {
      const base = line.fillTo === 'zero' ? line.values.map(() => 0) : spec.lines[line.fillTo].values
      body += `<path d="M${[...points(line.values), ...points(base).reverse()].join('L')}Z" fill="${colour}" fill-opacity="0.85"/>`
    }
  })
  spec.lines.forEach((line) => {
    if (line.dots)
      body += points(line.values)
        .map((p) => `<circle cx="${p.split(',')[0]}" cy="${p.split(',')[1]}" r="2" fill="${token(line.colour)}"/>`)
        .join('')
    else if (line.fillTo === undefined)
      body += `<path d="${stretches(line.values)
        .map((one) => `M${one.join('L')}`)
        .join('')}" fill="none" stroke="${token(line.colour)}" stroke-width="${line.width ?? 1.5}"${dashes(line)}/>`
  })
  body += `<path d="M${left} ${top}V${height - bottom}H${width - right}" fill="none" stroke="${token('--ink')}"/>`
  body +=
    label((left + width - right) / 2, height - 8, axisTitle(spec.x), 'middle') +
    label(0, 0, axisTitle(spec.y), 'middle', `transform="translate(14 ${(top + height - bottom) / 2}) rotate(-90)"`)
  for (const { line, x, row } of entries) {
    const y = 38 + LEGEND_ROW * row
    body +=
      `<path d="M${x} ${y}h22" stroke="${token(line.colour)}" stroke-width="3"${dashes(line)}/>` +
      label(x + 27, y + 4, line.label)
  }
  return picture(width, height, body)
}
