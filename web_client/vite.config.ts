import { fileURLToPath } from 'node:url'
import { svelte } from '@sveltejs/vite-plugin-svelte'
import { defineConfig, type Plugin } from 'vite'

const here = (path: string) => fileURLToPath(new URL(path, import.meta.url))
const relay = process.env['SWITCHBOARD_URL'] ?? 'http://127.0.0.1:9090'

/** roslib carries a whole XML parser for robot models, which the portal does not read. Its one call at the top keeps it
 * in the bundle; called pure it goes. Where the line is not found the portal is only larger.
 */
const withoutXml: Plugin = {
  name: 'roslib-without-xml',
  transform(code, id) {
    if (!id.includes('/roslib/dist/RosLib')) return null
    return code.replace(/^var (\w+) = (\w+)\(\);$/m, 'var $1 = /* @__PURE__ */ $2();')
  },
}

export default defineConfig({
  plugins: [svelte(), withoutXml],
  // Absolute, because index.html also answers for /cockpit/<robot>, where relative addresses would miss.
  base: '/',
  resolve: {
    alias: {
      // roslib imports these for encodings the portal never asks for.
      bson: here('./src/lib/unused-encodings.ts'),
      cbor2: here('./src/lib/unused-encodings.ts'),
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
      '/api': { target: relay, ws: true },
      '/robots': { target: relay, ws: true },
    },
  },
})
