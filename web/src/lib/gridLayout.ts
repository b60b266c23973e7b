//! Where the cells of a layered grid plot lie: layers across, bands down.
import type { Lake, Point } from './api'

export interface Cell {
  readonly point: Point
  readonly x: number
  readonly y: number
  readonly size: number
}
export interface Block {
  readonly layer: number
  readonly x: number
  readonly side: number
  readonly inset: number
  readonly extent: number
  readonly cells: readonly Cell[]
}
export interface Layout {
  readonly blocks: readonly Block[]
  readonly rowTops: readonly number[]
  readonly width: number
  readonly height: number
  readonly side: number
  readonly left: number
  readonly top: number
}

const GAP = 10
const ROW_GAP = 10

/** Blocks in whole pixels; one a layer, repeated for each band. x grows to the right, y upwards, as seen from above. */
export function layout(lake: Lake, width: number, rows: number): Layout {
  const left = width < 420 ? 46 : 58
  const top = 22
  const layers = Array.from({ length: lake.layers }, (_, layer) => lake.points.filter((p) => p.layer === layer))
  const side = Math.max(24, Math.floor((width - left - GAP * (layers.length - 1)) / layers.length))
  const blocks = layers.map((points, layer): Block => {
    const x = left + layer * (side + GAP)
    const xs = [...new Set(points.map((p) => p.x_mm))].sort((a, b) => a - b)
    const ys = [...new Set(points.map((p) => p.y_mm))].sort((a, b) => a - b)
    const many = Math.max(xs.length, ys.length)
    const size = many === 1 ? Math.floor(side / 3) : Math.floor((side - 2) / many)
    const inset = Math.floor((side - size * many) / 2)
    const cells = points.map((point): Cell => ({
      point,
      x: x + inset + xs.indexOf(point.x_mm) * size,
      y: inset + (ys.length - 1 - ys.indexOf(point.y_mm)) * size,
      size,
    }))
    return { layer, x, side, inset, extent: size * many, cells }
  })
  const rowTops = Array.from({ length: rows }, (_, row) => top + row * (side + ROW_GAP))
  return { blocks, rowTops, width, height: top + rows * (side + ROW_GAP), side, left, top }
}
