//! How the pages keep answers, without a server: `node tests/answers.mjs`. Vite compiles the sources, as for the pages.
import assert from 'node:assert/strict'
import { createServer } from 'vite'

const vite = await createServer({ server: { middlewareMode: true }, appType: 'custom', logLevel: 'error' })
const { get } = await vite.ssrLoadModule('/src/lib/api.ts')

let now_ms = 0
performance.now = () => now_ms
const requests = []
const { fetch } = globalThis
globalThis.fetch = () =>
  new Promise((resolve, reject) =>
    requests.push({
      answer: (value) => resolve(Response.json(value)),
      fail: () => reject(new TypeError('no network')),
    }),
  )

const early = get('/api/v1/lake')
assert.equal(get('/api/v1/lake'), early, 'a fresh answer is kept, also while it is on its way')
now_ms = 31_000
const late = get('/api/v1/lake')
assert.equal(requests.length, 2, 'an old one is asked for again')
requests[0].fail()
await assert.rejects(early, { code: 'lake_unreadable' })
requests[1].answer({ name: 'runs' })
assert.deepEqual(await late, { name: 'runs' })
assert.equal(get('/api/v1/lake'), late, 'the failure of the old one leaves the new one')
now_ms = 62_000
const failed = get('/api/v1/lake')
requests[2].fail()
await assert.rejects(failed, { code: 'lake_unreadable' })
void get('/api/v1/lake')
assert.equal(requests.length, 4, 'a failure is not kept')
process.stdout.write('ok answers are kept, failures are not\n')
// Checks of the pages in a browser follow in the same program.
globalThis.fetch = fetch
delete performance.now

await vite.close()
