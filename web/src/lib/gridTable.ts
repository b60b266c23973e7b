//! The grid plot's numbers.
import type { Grid, Lake } from './api'
import type { TableData } from './plot'
import { unitOf } from './reference'

export function gridTable(lake: Lake, grid: Grid): TableData {
  const unit = (key: string) => unitOf(key === 'total' ? 'flat-total' : grid.over)
  return {
    columns: [
      'point',
      'layer',
      'gridx',
      'gridy',
      'x_mm',
      'y_mm',
      'z_mm',
      'pair',
      'measured the other way round',
      ...lake.bands.map((band) => `tnce ${band.label}, ${unit(band.key)}`),
    ],
    rows: lake.points.map((p) => [
      p.point_id,
      p.layer,
      p.gridx,
      p.gridy,
      p.x_mm,
      p.y_mm,
      p.z_mm,
      grid.pairs[p.point_id],
      grid.swapped[p.point_id],
      ...lake.bands.map((_, b) => grid.bands[b][p.point_id]),
    ]),
  }
}
