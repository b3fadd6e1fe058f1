import { fileURLToPath } from 'node:url'
import { svelte } from '@sveltejs/vite-plugin-svelte'
import { defineConfig } from 'vite'

const here = (path: string) => fileURLToPath(new URL(path, import.meta.url))
const relay = process.env['SWITCHBOARD_URL'] ?? 'http://127.0.0.1:9090'

export default defineConfig({
  plugins: [svelte()],
  // Absolute, because index.html also answers for /cockpit/<robot>, where relative addresses would miss.
  base: '/',
  resolve: {
    alias: {
      // roslib imports these for encodings the portal never asks for.
      bson: here('./src/lib/unused-encodings.ts'),
      'fast-png': here('./src/lib/unused-encodings.ts'),
      ws: here('./src/lib/unused-encodings.ts'),
    },
  },
  build: {
    outDir: here('../relay_server/portal'),
    emptyOutDir: true,
    target: 'es2022',
    license: { fileName: 'licences.md' },
    modulePreload: { polyfill: false },
  },
  server: {
    proxy: {
      '/api': relay,
      '/robots': { target: relay, ws: true },
    },
  },
})
