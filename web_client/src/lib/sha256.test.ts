import { createHash } from 'node:crypto'
import { expect, it } from 'vitest'
import { Sha256 } from './sha256'

it.each([0, 1, 55, 56, 63, 64, 65, 119, 128, 1000])('hashes %i bytes, whole and in parts', (size) => {
  const data = Uint8Array.from({ length: size }, (_, i) => (i * 7) % 256)
  const expected = createHash('sha256').update(data).digest('hex')
  expect(new Sha256().update(data).hex()).toBe(expected)
  const parts = new Sha256()
  for (let at = 0; at < size; at += 37) parts.update(data.subarray(at, at + 37))
  expect(parts.hex()).toBe(expected)
})
