//! Grey PNG and the light that falls on a relief.
import { deflateSync, crc32 as zlibCrc } from 'node:zlib'

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k += 1) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1
  return n >>> 0
})
const crc32 = zlibCrc ?? ((bytes) => {
  let c = 0xffffffff
  for (const b of bytes) c = TABLE[(c ^ b) & 255] ^ (c >>> 8)
  return (c ^ 0xffffffff) >>> 0
})

function chunk(kind, data) {
  const body = Buffer.concat([Buffer.from(kind, 'latin1'), data])
  const out = Buffer.alloc(body.length + 8)
  out.writeUInt32BE(data.length, 0)
  body.copy(out, 4)
  out.writeUInt32BE(crc32(body), body.length + 4)
  return out
}

/** 8-bit grey. */
export function greyPng(pixels, width, height) {
  const header = Buffer.alloc(13)
  header.writeUInt32BE(width, 0)
  header.writeUInt32BE(height, 4)
  header.set([8, 0, 0, 0, 0], 8)
  const raw = Buffer.alloc((width + 1) * height)
  for (let y = 0; y < height; y += 1) raw.set(pixels.subarray(y * width, (y + 1) * width), y * (width + 1) + 1)
  return Buffer.concat([Buffer.from([137, 80, 78, 71, 13, 10, 26, 10]), chunk('IHDR', header), chunk('IDAT', deflateSync(raw, { level: 9 })), chunk('IEND', Buffer.alloc(0))])
}

/** Lambert's light from the upper left at 40 degrees above the plane; slopes doubled so that shallow reliefs are seen. */
export function hillshade(heights, cells, size_mm) {
  const pixels = new Uint8Array(cells * cells)
  const pitch = size_mm / cells
  const [lx, ly, lz] = [-0.54, 0.54, 0.643]
  const at = (r, c) => heights[Math.min(cells - 1, Math.max(0, r)) * cells + Math.min(cells - 1, Math.max(0, c))]
  for (let r = 0; r < cells; r += 1) {
    for (let c = 0; c < cells; c += 1) {
      const gx = (at(r, c + 1) - at(r, c - 1)) / pitch
      const gy = (at(r + 1, c) - at(r - 1, c)) / pitch
      const light = (lz - gx * lx - gy * ly) / Math.hypot(1, gx, gy)
      pixels[(cells - 1 - r) * cells + c] = Math.max(18, Math.min(250, 40 + 225 * light))
    }
  }
  return greyPng(pixels, cells, cells)
}
