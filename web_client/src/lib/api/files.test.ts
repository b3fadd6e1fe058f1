import { createHash } from 'node:crypto'
import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { FIRST_BYTES, nameBelow, nextSize, upload, type UploadStep } from './files'

/** A relay that keeps one file. Each request ends as `faults` says, once the list is empty well. */
let stored: Uint8Array<ArrayBuffer>
let places: string[]
let faults: ((received: number) => Response | Error | null)[]
const content = Uint8Array.from({ length: FIRST_BYTES * 4 }, (_, i) => (i * 31) % 256)
const sha256 = createHash('sha256').update(content).digest('hex')

beforeEach(() => {
  stored = new Uint8Array(0)
  places = []
  faults = []
  vi.stubGlobal('fetch', async (address: string, { headers, body }: { headers: Record<string, string>; body: Blob }) => {
    expect(address).toContain(`/api/v1/robots/rover/files/maps%2Fhall?sha256=${sha256}`)
    places.push(headers['Content-Range']!)
    const fault = faults.shift()?.(stored.length) ?? null
    if (fault instanceof Error) throw fault
    if (fault !== null) return fault
    const part = new Uint8Array(await body.arrayBuffer())
    const longer = new Uint8Array(stored.length + part.length)
    longer.set(stored)
    longer.set(part, stored.length)
    stored = longer
    const done = stored.length === content.length
    return Response.json(done ? { name: 'maps/hall', sha256 } : { received: stored.length }, { status: done ? 201 : 202 })
  })
})
afterEach(() => vi.unstubAllGlobals())

const file = new Blob([content])
const waits: number[] = []
function run(signal = new AbortController().signal, progress: (step: UploadStep, share: number) => void = () => {}) {
  waits.length = 0
  const wait = (ms: number) => Promise.resolve(void waits.push(ms))
  return upload({ robot: 'rover', name: 'maps/hall', file, signal, progress, wait })
}

it('sends a file in parts', async () => {
  const shares: number[] = []
  expect(await run(undefined, (step, share) => step === 'sending' && shares.push(share))).toMatchObject({ sha256 })
  expect(Buffer.compare(stored, content)).toBe(0)
  expect(places.slice(0, 2)).toEqual([`bytes */${content.length}`, `bytes 0-${FIRST_BYTES - 1}/${content.length}`])
  expect(shares).toEqual([...shares].sort((a, b) => a - b))
})

it('goes on where the relay is after a cut, and after parts were lost', async () => {
  const cut = () => new TypeError('network error')
  const gap = () => {
    stored = stored.slice(0, 10)
    return Response.json({ detail: 'the next part must begin at byte 10' }, { status: 409 })
  }
  faults = [() => null, () => null, cut, cut, () => null, gap]
  await run()
  expect(Buffer.compare(stored, content)).toBe(0)
  expect(waits).toEqual([500, 1000, 2000])
})

it.each([
  [403, 'Only owners manage.'],
  [409, 'The quota is used up.'],
  [422, 'The contents are others.'],
])('ends with the words of the relay at %i', async (status, detail) => {
  faults = [() => Response.json({ detail }, { status })]
  await expect(run()).rejects.toThrow(detail)
  expect(waits).toEqual([])
})

it('gives up when the relay stays away', async () => {
  faults = Array.from({ length: 20 }, () => () => new TypeError('network error'))
  await expect(run()).rejects.toThrow('does not answer')
  expect(waits).toEqual([500, 1000, 2000, 4000, 8000])
})

it('gives up when each part is refused', async () => {
  const busy = () => Response.json({ detail: 'too much at once' }, { status: 503 })
  faults = Array.from({ length: 20 }, (_, i) => (i % 2 === 0 ? () => null : busy))
  await expect(run()).rejects.toThrow('Too much at once')
  expect(waits).toHaveLength(5)
})

it('ends when the user cancels', async () => {
  const cancel = new AbortController()
  faults = [() => null, () => (cancel.abort(), new TypeError('aborted'))]
  await expect(run(cancel.signal)).rejects.toThrow('abort')
  expect(places).toHaveLength(2)
})

it.each([
  ['', 'a.yaml', 'a.yaml'],
  ['/maps/', 'hall.yaml', 'maps/hall.yaml'],
  [' maps // x', 'day 1/a', 'maps/x/day 1/a'],
])('names a file in %j', (folder, name, whole) => {
  expect(nameBelow(folder, name)).toBe(whole)
})

it.each([
  [FIRST_BYTES, 100, FIRST_BYTES * 2],
  [2 ** 23, 100, 2 ** 23],
  [FIRST_BYTES, 2000, FIRST_BYTES],
  [FIRST_BYTES, 9000, FIRST_BYTES / 2],
  [64 * 1024, 9000, 64 * 1024],
])('a part of %i bytes that took %i ms is followed by one of %i', (size, ms, next) => {
  expect(nextSize(size, ms)).toBe(next)
})
