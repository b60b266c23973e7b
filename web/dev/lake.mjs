//! A lake, asked through the command `echolake sql`: what the server does in one process, for developing pages.
import { execFile } from 'node:child_process'
import { readFile, mkdtemp, rm } from 'node:fs/promises'
import { tmpdir } from 'node:os'
import { join } from 'node:path'
import { tableFromIPC } from '@uwdata/flechette'

const KEPT = 400
const AT_ONCE = 2

/** Refused or failed query; `message` is the command's own. */
export class QueryError extends Error {}

/** @param {string} command path of the binary @param {string} folder the lake */
export function openLake(command, folder) {
  const kept = new Map()
  const waiting = []
  let running = 0

  const turn = () => new Promise((go) => {
    if (running < AT_ONCE) { running += 1; go() } else waiting.push(go)
  })
  const done = () => { const next = waiting.shift(); if (next) next(); else running -= 1 }

  async function run(query, args, signal) {
    await turn()
    try {
      return await new Promise((resolve, reject) => {
        const options = { maxBuffer: 1 << 30, encoding: 'buffer', signal }
        execFile(command, ['--lake', folder, 'sql', ...args, query], options, (error, stdout, stderr) => {
          if (error) reject(new QueryError(stderr.toString().trim() || error.message))
          else resolve(stdout)
        })
      })
    } finally { done() }
  }

  async function toFile(query, format, signal) {
    const place = await mkdtemp(join(tmpdir(), 'echolake-dev-'))
    try {
      const file = join(place, 'answer')
      await run(query, ['--format', format, '-o', file], signal)
      return await readFile(file)
    } finally { await rm(place, { recursive: true, force: true }) }
  }

  function remember(key, make) {
    if (!kept.has(key)) {
      const answer = make()
      answer.catch(() => kept.delete(key))
      kept.set(key, answer)
      if (kept.size > KEPT) kept.delete(kept.keys().next().value)
    }
    return kept.get(key)
  }

  return {
    folder,
    /** Rows as objects. */
    rows: (query) => remember(query, async () => JSON.parse((await run(query, ['--format', 'json'])).toString() || '[]')),
    /** Rows as an Arrow table. */
    table: (query) => remember('arrow:' + query, async () => tableFromIPC(await toFile(query, 'arrow'))),
    /** The answer's bytes in a format of the command. */
    bytes: (query, format, signal) => toFile(query, format, signal),
    /** What is computed once. */
    once: (name, make) => remember('once:' + name, make),
  }
}

/** A string as an SQL literal. */
export const text = (value) => `'${String(value).replaceAll("'", "''")}'`
