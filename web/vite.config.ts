//! Builds the pages for a server whose Content-Security-Policy forbids everything inline. What is text is packed here,
//! once, so that the server has nothing to pack.
import { readdir, readFile, writeFile } from 'node:fs/promises'
import { join } from 'node:path'
import { brotliCompressSync, gzipSync } from 'node:zlib'
import { svelte } from '@sveltejs/vite-plugin-svelte'
import { defineConfig, type Plugin, type ProxyOptions } from 'vite'

const TEXT = /\.(html|js|css|svg|txt|json)$/
/** Smaller files fit a packet. */
const WORTH_PACKING = 1000

/** Modules that pages share, but for what draws plots, which not every page has. */
const SHARED = /src\/(?!components\/Plot)|node_modules\/(?!uplot)/

/** Licences of all packages that are part of the pages, and served with them. */
const LICENCES = 'licences.json'

/** Fonts and styles are no modules, so Vite's list of licences leaves their packages out. */
async function withFontLicences(path: string) {
  const listed: { name: string }[] = JSON.parse(await readFile(path, 'utf8'))
  const { dependencies } = JSON.parse(await readFile('package.json', 'utf8'))
  for (const name of Object.keys(dependencies).filter((name) => !listed.some((entry) => entry.name === name))) {
    const folder = join('node_modules', name)
    const { version, license: identifier } = JSON.parse(await readFile(join(folder, 'package.json'), 'utf8'))
    const entry = { name, version, identifier, text: await readFile(join(folder, 'LICENSE'), 'utf8') }
    listed.push(entry)
  }
  await writeFile(path, JSON.stringify(listed, null, 1))
}

function packed(): Plugin {
  return {
    name: 'packed',
    apply: 'build',
    async closeBundle() {
      const folder = join(import.meta.dirname, 'dist')
      await withFontLicences(join(folder, LICENCES))
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

/** The server that answers while the pages are worked on. */
const SERVER = process.env.ECHOLAKE ?? 'http://127.0.0.1:8080'

/** Passes requests on to it. To the server, pages of this port are elsewhere; they alone are made its own. */
const toServer: ProxyOptions = {
  target: SERVER,
  changeOrigin: true,
  configure: (proxy) =>
    proxy.on('proxyReq', (passed, request) => {
      if (request.headers.origin === `http://${request.headers.host}`) passed.setHeader('origin', SERVER)
    }),
}

export default defineConfig({
  plugins: [svelte(), packed()],
  server: { proxy: { '/api': toServer, '/health': toServer, '/metrics': toServer } },
  // Addresses in the document are relative, so that a proxy may serve the pages below a path of its own.
  base: './',
  build: {
    target: 'es2022',
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    reportCompressedSize: true,
    chunkSizeWarningLimit: 900,
    license: { fileName: LICENCES },
    // One style sheet, and one chunk of what pages share: requests cost more than a few kB.
    cssCodeSplit: false,
    rolldownOptions: {
      output: {
        codeSplitting: { groups: [{ name: 'shared', test: SHARED, minShareCount: 2 }] },
      },
    },
  },
})
