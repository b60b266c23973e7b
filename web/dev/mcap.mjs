//! Topics and sizes of a run file, from its summary and message indexes.
import { open } from 'node:fs/promises'

const u64 = (b, o) => Number(b.readBigUInt64LE(o))
const string = (b, o) => [b.toString('utf8', o + 4, o + 4 + b.readUInt32LE(o)), o + 4 + b.readUInt32LE(o)]

/** Topics with counts and bytes, attachments, and where each attachment's data lie. */
export async function summary(path) {
  const file = await open(path)
  try {
    const { size } = await file.stat()
    const read = async (offset, length) => { const b = Buffer.alloc(length); await file.read(b, 0, length, offset); return b }
    const footer = await read(size - 8 - 20, 20)
    const start = u64(footer, 0)
    if (start === 0) return { topics: [], attachments: [] }
    const section = await read(start, size - 8 - 29 - start)
    const [schemas, channels, chunks, attachments, counts] = [new Map(), new Map(), [], [], new Map()]
    for (let o = 0; o + 9 <= section.length;) {
      const op = section[o]
      const length = u64(section, o + 1)
      const b = section.subarray(o + 9, o + 9 + length)
      o += 9 + length
      if (op === 0x03) { const [name, next] = string(b, 2); schemas.set(b.readUInt16LE(0), { name, encoding: string(b, next)[0] }) }
      if (op === 0x04) { const [topic, next] = string(b, 4); channels.set(b.readUInt16LE(0), { topic, schema: b.readUInt16LE(2), encoding: string(b, next)[0] }) }
      if (op === 0x08) { chunks.push({ b }) }
      if (op === 0x0a) {
        const [name, next] = string(b, 40)
        attachments.push({ offset: u64(b, 0), length: u64(b, 8), bytes: u64(b, 32), name, media_type: string(b, next)[0] })
      }
      if (op === 0x0b) readCounts(b, counts)
    }
    const bytes = await sizes(chunks, read)
    const topics = [...channels].map(([id, c]) => ({
      topic: c.topic, schema: schemas.get(c.schema)?.name ?? '', encoding: c.encoding, messages: counts.get(id) ?? 0, bytes: bytes.get(id) ?? null,
    })).sort((a, b) => (b.bytes ?? 0) - (a.bytes ?? 0))
    return { topics, attachments }
  } finally { await file.close() }
}

function readCounts(b, counts) {
  const fixed = 8 + 2 + 4 + 4 + 4 + 4 + 8 + 8
  const length = b.readUInt32LE(fixed)
  for (let o = fixed + 4; o < fixed + 4 + length; o += 10) counts.set(b.readUInt16LE(o), u64(b, o + 2))
}

/** A message's size is the way to the next offset within its chunk. */
async function sizes(chunks, read) {
  const bytes = new Map()
  for (const { b } of chunks) {
    const mapLength = b.readUInt32LE(32)
    let o = 36 + mapLength
    const indexLength = u64(b, o)
    const [, afterCompression] = string(b, o + 8)
    const uncompressed = u64(b, afterCompression + 8)
    if (mapLength === 0) continue
    const first = Math.min(...Array.from({ length: mapLength / 10 }, (_, i) => u64(b, 36 + i * 10 + 2)))
    const index = await read(first, indexLength)
    const all = []
    for (let at = 0; at + 9 <= index.length;) {
      const length = u64(index, at + 1)
      if (index[at] === 0x07) {
        const channel = index.readUInt16LE(at + 9)
        for (let k = at + 15; k < at + 9 + length; k += 16) all.push([u64(index, k + 8), channel])
      }
      at += 9 + length
    }
    all.sort((x, y) => x[0] - y[0])
    all.forEach(([offset, channel], i) => bytes.set(channel, (bytes.get(channel) ?? 0) + (all[i + 1]?.[0] ?? uncompressed) - offset))
  }
  return bytes
}

/** The bytes of the attachment with this ending. */
export async function attachment(path, ending) {
  const { attachments } = await summary(path)
  const found = attachments.find((a) => a.name.endsWith(ending))
  if (!found) return null
  const file = await open(path)
  try {
    const record = Buffer.alloc(found.length)
    await file.read(record, 0, found.length, found.offset)
    const [, afterName] = string(record, 9 + 16)
    const [, afterMedia] = string(record, afterName)
    return record.subarray(afterMedia + 8, afterMedia + 8 + found.bytes)
  } finally { await file.close() }
}
