import { describe, expect, it } from 'vitest'
import { type Cells, cellsOf, halved, known, levels, palette, patched, pixels } from './grid'

const grid = (width: number, height: number, data: number[]): Cells => ({ width, height, data: Int8Array.from(data) })
const rgba = (bytes: Uint8ClampedArray, pixel: number) => Array.from(bytes.slice(pixel * 4, pixel * 4 + 4))

describe('cells of a message', () => {
  const info = { resolution: 0.05, width: 2, height: 1, origin: {} as never }

  it('are taken as they come, from JSON or CBOR', () => {
    const bytes = Int8Array.of(0, -1)
    expect(cellsOf({ info, data: bytes }).data).toBe(bytes)
    expect(cellsOf({ info, data: [0, 100] }).data).toEqual(Int8Array.of(0, 100))
  })

  it('must be as many as the size says', () => {
    expect(() => cellsOf({ info, data: [0] })).toThrow('2 × 1 cells has 1')
    expect(() => cellsOf({ info: { ...info, resolution: 0 }, data: [0, 0] })).toThrow('0 m wide')
  })

  it('are replaced by an update that fits', () => {
    const before = grid(3, 2, [0, 0, 0, 0, 0, 0])
    const after = patched(before, { x: 1, y: 1, width: 2, height: 1, data: [5, 6] })
    expect(Array.from(after!.data)).toEqual([0, 0, 0, 0, 5, 6])
    expect(Array.from(before.data)).toEqual([0, 0, 0, 0, 0, 0])
    expect(patched(before, { x: 2, y: 0, width: 2, height: 1, data: [1, 1] })).toBeNull()
    expect(patched(before, { x: 0, y: 0, width: 2, height: 1, data: [1] })).toBeNull()
  })
})

it('a halved grid keeps thin walls, and free cells beside unknown ones', () => {
  const half = halved(grid(3, 3, [-1, -1, 0, -1, 100, 0, 0, -1, -1]))
  expect(half).toMatchObject({ width: 2, height: 2 })
  expect(Array.from(half.data)).toEqual([100, 0, 0, -1])
})

it('has levels down to an overview', () => {
  const found = Array.from(levels({ width: 2000, height: 10, data: new Int8Array(20_000) }))
  expect(found.map(({ factor, cells }) => [factor, cells.width])).toEqual([[1, 2000], [2, 1000], [4, 500]])
})

it('halves a grid that is too large for one picture', () => {
  const [first] = levels({ width: 8192, height: 4096, data: new Int8Array(8192 * 4096) })
  expect([first!.factor, first!.cells.width]).toEqual([2, 4096])
})

it('knows the rectangle of known cells', () => {
  expect(known(grid(4, 3, [-1, -1, -1, -1, -1, 0, 100, -1, -1, -1, -1, -1]))).toEqual({ minX: 1, minY: 1, maxX: 3, maxY: 2 })
  expect(known(grid(2, 1, [-1, -1]))).toBeNull()
})

describe('colours', () => {
  it('of a map: unknown is transparent, occupied brighter than free', () => {
    const bytes = pixels(grid(4, 1, [-1, 0, 100, 101]), palette('map'))
    expect(rgba(bytes, 0)[3]).toBe(0)
    expect(rgba(bytes, 1)[3]).toBe(255)
    expect(rgba(bytes, 2)[0]).toBeGreaterThan(rgba(bytes, 1)[0]! + 100)
    expect(rgba(bytes, 3)[3]).toBe(0)
  })

  it('of a costmap: free is transparent, and the more it costs the less is seen through it', () => {
    const bytes = pixels(grid(5, 1, [0, 1, 98, 99, 100]), palette('costmap'))
    const alpha = [0, 1, 2, 3, 4].map((i) => rgba(bytes, i)[3]!)
    expect(alpha[0]).toBe(0)
    expect(alpha).toEqual(alpha.toSorted((a, b) => a - b))
    expect(rgba(bytes, 3)).not.toEqual(rgba(bytes, 4))
  })
})
