import { appendFileSync, readFileSync } from 'node:fs'
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

/** Styles that Sass imports are not among the modules whose licences Vite collects. */
const bootstrapLicence: Plugin = {
  name: 'bootstrap-licence',
  writeBundle({ dir }) {
    const folder = here('./node_modules/bootstrap/')
    const { version } = JSON.parse(readFileSync(`${folder}package.json`, 'utf8')) as { version: string }
    const text = readFileSync(`${folder}LICENSE`, 'utf8')
    appendFileSync(`${dir}/licences.md`, `\n## bootstrap - ${version} (MIT)\n\n${text}`)
  },
}

export default defineConfig({
  plugins: [svelte(), withoutXml, bootstrapLicence],
  // Absolute, because index.html also answers for /cockpit/<robot>, where relative addresses would miss.
  base: '/',
  resolve: {
    alias: {
      cbor2: here('./src/lib/ros/cbor.ts'),
      // roslib imports these for encodings the portal never asks for.
      bson: here('./src/lib/ros/unused-encodings.ts'),
      'fast-png': here('./src/lib/ros/unused-encodings.ts'),
      ws: here('./src/lib/ros/unused-encodings.ts'),
    },
  },
  css: {
    // Bootstrap 5 is written in the older Sass.
    preprocessorOptions: {
      scss: { quietDeps: true, silenceDeprecations: ['import', 'global-builtin', 'color-functions', 'if-function'] },
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
