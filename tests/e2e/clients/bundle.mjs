// Puts a program and the packages of the portal that it imports into one file for a browser.
//
// node bundle.mjs <folder node_modules> <program> <bundle>
import { pathToFileURL } from 'node:url'

const [modules, input, file] = process.argv.slice(2)
const { rolldown } = await import(pathToFileURL(`${modules}/rolldown/dist/index.mjs`))
const bundle = await rolldown({ input, platform: 'browser', resolve: { modules: [modules], alias: { ws: false } } })
await bundle.write({ file, format: 'esm', codeSplitting: false })
await bundle.close()
