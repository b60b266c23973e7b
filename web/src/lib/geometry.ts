//! Points of the grid, and paths of a pair over the panel's plane.
import type { Lake } from './api'

/** The point of this number; null if there is none. */
export const pointNamed = (lake: Lake, name: string | null): number | null =>
  name !== null && /^\d+$/.test(name) && Number(name) < lake.points.length ? Number(name) : null

/** The point in the middle of the lowest layer. */
export const middlePoint = (lake: Lake): number =>
  lake.points
    .filter((p) => p.layer === 0)
    .reduce((best, p) => (Math.hypot(p.x_mm, p.y_mm) < Math.hypot(best.x_mm, best.y_mm) - 1e-6 ? p : best)).point_id

export type Vec3 = readonly [number, number, number]

/** Where the image path meets the plane z = 0. */
export function specular(a: Vec3, b: Vec3): Vec3 {
  const share = a[2] / (a[2] + b[2])
  return [a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, 0]
}

/** First Fresnel zone on z = 0: points whose way by the plane is at most half a wavelength longer than the image path. */
export function fresnelZone(
  a: Vec3,
  b: Vec3,
  frequency_hz: number,
  speed_m_s = 343,
): { centre: Vec3; along: number; across: number; angle: number } {
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]]
  const r = Math.hypot(dx, dy)
  const [h1, h2] = [a[2], b[2]]
  const length = Math.hypot(r, h1 + h2) + (1000 * speed_m_s) / frequency_hz / 2
  const kk = h1 * h1 - h2 * h2 - r * r
  const aa = 4 * (length * length - r * r)
  const bb = -4 * r * (length * length + kk)
  const cc = 4 * length * length * h1 * h1 - (length * length + kk) ** 2
  const g = (bb * bb) / (4 * aa) - cc
  const x = -bb / (2 * aa)
  const angle = Math.atan2(dy, dx)
  return {
    centre: [a[0] + x * Math.cos(angle), a[1] + x * Math.sin(angle), 0],
    along: Math.sqrt(g / aa),
    across: Math.sqrt(g) / (2 * length),
    angle,
  }
}
