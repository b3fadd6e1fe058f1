import { expect, it } from 'vitest'
import { argumentsOf, base64, duration, ranFor, valuesOf } from './functions'
import type { JobStatus } from './types'

const SCHEMA = {
  $ref: '#/$defs/detect',
  $defs: {
    detect: {
      type: 'object',
      properties: {
        image: { type: 'string', contentEncoding: 'base64', contentMediaType: 'image/jpeg' },
        words: { type: 'string', default: '4X4_50' },
        size: { type: 'number', default: 0.1 },
        quality: { type: 'integer', minimum: 1, maximum: 100 },
        fast: { type: 'boolean', default: false },
        camera: { anyOf: [{ type: 'array' }, { type: 'null' }], default: null },
      },
      required: ['image', 'quality'],
    },
  },
}
const FIELDS = argumentsOf(SCHEMA)

it('makes fields of a signature', () => {
  expect(FIELDS.map(({ name, kind, required, initial }) => [name, kind, required, initial])).toEqual([
    ['image', 'file', true, ''],
    ['words', 'text', false, '4X4_50'],
    ['size', 'number', false, '0.1'],
    ['quality', 'integer', true, ''],
    ['fast', 'flag', false, 'false'],
    ['camera', 'json', false, 'null'],
  ])
  expect(FIELDS.map(({ hint }) => hint)).toEqual(['image/jpeg', 'text', 'number', '1 to 100', '', 'JSON'])
})

it('reads values of the fields', () => {
  expect(valuesOf(FIELDS, { image: 'AAA=', quality: '85', camera: '[1, 2]', size: '' })).toEqual({
    image: 'AAA=',
    words: '4X4_50',
    quality: 85,
    fast: false,
    camera: [1, 2],
  })
})

it.each([
  [{ quality: '1' }, 'image is missing.'],
  [{ image: 'A', quality: '1.5' }, 'quality must be a whole number.'],
  [{ image: 'A', quality: '1', size: '"x"' }, 'size must be a number.'],
  [{ image: 'A', quality: '1', camera: '[' }, 'camera is not valid JSON.'],
])('says what is wrong with %j', (entered, words) => {
  expect(valuesOf(FIELDS, entered)).toBe(words)
})

it('encodes files of any size', async () => {
  const bytes = Uint8Array.from({ length: 100_000 }, (_, i) => i % 256)
  expect(await base64(new Blob([bytes]))).toBe(Buffer.from(bytes).toString('base64'))
})

it.each([
  [null, '–'],
  [0.0001, '1 ms'],
  [0.0353, '35 ms'],
  [1.26, '1.3 s'],
  [61.2, '61 s'],
])('says %s s as %s', (seconds, words) => {
  expect(duration(seconds)).toBe(words)
})

it.each([
  [{ run_seconds: 2, started: 1, ended: 9 }, 2],
  [{ run_seconds: null, started: 10, ended: null }, 5],
  [{ run_seconds: null, started: 10, ended: 12 }, 2],
  [{ run_seconds: null, started: null, ended: null }, null],
])('knows how long %j ran', (times, seconds) => {
  expect(ranFor(times as JobStatus, 15)).toBe(seconds)
})
