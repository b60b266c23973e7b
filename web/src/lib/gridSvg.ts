//! The layered grid plot on paper.
import type { Grid, Lake } from './api'
import { css, inkOn, levelColour, SCALE_DB, token } from './colour'
import { layout } from './gridLayout'
import { label, picture } from './svg'
import { settings } from './settings.svelte'

export function gridSvg(lake: Lake, grid: Grid, title: string): string {
  const plan = layout(lake, 560, lake.bands.length)
  let body = `<g transform="translate(12 34)">${label(0, -14, title, 'start', 'font-weight="600"')}`
  for (const block of plan.blocks)
    body += label(
      block.x + block.side / 2,
      14,
      `${lake.points.find((p) => p.layer === block.layer)?.z_mm ?? ''} mm`,
      'middle',
    )
  lake.bands.forEach((band, row) => {
    const top = plan.rowTops[row]
    body += label(0, top + plan.side / 2 + 4, band.label)
    for (const block of plan.blocks) {
      body += `<rect x="${block.x + block.inset - 1}" y="${top + block.inset - 1}" width="${block.extent + 2}" height="${block.extent + 2}" fill="${token('--plot-block')}"/>`
      for (const cell of block.cells) {
        const id = cell.point.point_id
        const value = grid.bands[row][id]
        const [cx, cy] = [cell.x + cell.size / 2, top + cell.y + cell.size / 2 + 4]
        const colour = value === null ? null : levelColour(value, settings.palette)
        body += `<rect x="${cell.x}" y="${top + cell.y}" width="${cell.size}" height="${cell.size}" fill="${id === grid.microphone ? token('--accent') : colour ? css(colour) : token('--plot-block')}"/>`
        if (id === grid.microphone)
          body += `<text x="${cx}" y="${cy}" text-anchor="middle" font-weight="600" fill="${inkOn([11, 92, 140])}">M</text>`
        else if (value === null) body += label(cx, cy, '+', 'middle')
      }
    }
  })
  const steps = 52
  const at = (i: number) => SCALE_DB.low + ((SCALE_DB.high - SCALE_DB.low) * i) / (steps - 1)
  for (let i = 0; i < steps; i += 1)
    body += `<rect x="${plan.left + i * 5}" y="${plan.height + 4}" width="5.2" height="11" fill="${css(levelColour(at(i), settings.palette))}"/>`
  body += `<rect x="${plan.left}" y="${plan.height + 4}" width="${steps * 5}" height="11" fill="none" stroke="${token('--rule-2')}"/>`
  for (const db of [-20, -10, 0, 6])
    body += label(
      plan.left + (steps * 5 * (db - SCALE_DB.low)) / (SCALE_DB.high - SCALE_DB.low),
      plan.height + 29,
      `${db > 0 ? '+' : ''}${db}${db === 6 ? ' dB' : ''}`.replace('-', '\u2212'),
      'middle',
    )
  return picture(plan.width + 24, plan.height + 76, body + '</g>')
}
