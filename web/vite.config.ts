//! Builds the pages for a server whose Content-Security-Policy forbids everything inline. What is text is packed here,
//! once, so that the server has nothing to pack.
import { readdir, readFile, writeFile } from 'node:fs/promises'
import { join } from 'node:path'
import { brotliCompressSync, gzipSync } from 'node:zlib'
import { svelte } from '@sveltejs/vite-plugin-svelte'
import { defineConfig, type Plugin } from 'vite'

const TEXT = /\.(html|js|css|svg|txt|json)$/
/** Smaller files fit a packet. */
const WORTH_PACKING = 1000

function packed(): Plugin {
  return {
    name: 'packed', apply: 'build',
    async closeBundle() {
      const folder = join(import.meta.dirname, 'dist')
      for (const name of await readdir(folder, { recursive: true })) {
        if (!TEXT.test(name)) continue
        const bytes = await readFile(join(folder, name))
        if (bytes.length < WORTH_PACKING) continue
        await writeFile(join(folder, `${name}.gz`), gzipSync(bytes, { level: 9 }))
        await writeFile(join(folder, `${name}.br`), brotliCompressSync(bytes))
      }
    },
  }
}

export default defineConfig({
  plugins: [svelte(), packed()],
  build: { target: 'es2022', assetsInlineLimit: 0, modulePreload: { polyfill: false }, reportCompressedSize: true, chunkSizeWarningLimit: 900 },
})
