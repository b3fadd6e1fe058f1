/** Occupancy grids as pictures (nav_msgs/OccupancyGrid: rows from the origin upwards; -1 unknown, 0 free, 100 occupied). */
import type { OccupancyGrid, OccupancyGridUpdate } from '../ros/messages'

export type GridKind = 'map' | 'costmap'

export interface Cells {
  width: number
  height: number
  data: Int8Array
}

export interface Box {
  minX: number
  minY: number
  maxX: number
  maxY: number
}

/** A larger grid is drawn at half of its resolution, or less: 16.8 million cells are 67 MB of pixels. */
const MOST_CELLS = 1 << 24
/** Grids are halved down to this number of cells along the longer side, for the view from far away. */
const OVERVIEW = 512

/** The cells of a message, checked.
 *
 * @throws Error when the number of cells is not the one that its size says, or the size of a cell is no length
 */
export function cellsOf({ info: { width, height, resolution }, data }: Pick<OccupancyGrid, 'info' | 'data'>): Cells {
  if (!(resolution > 0)) throw new Error(`The cells of the grid are ${resolution} m wide.`)
  if (width * height !== data.length) {
    throw new Error(`The grid of ${width} × ${height} cells has ${data.length}.`)
  }
  return { width, height, data: data instanceof Int8Array ? data : Int8Array.from(data) }
}

/** The cells with a rectangle of them replaced (map_msgs/OccupancyGridUpdate); null where it does not fit. */
export function patched(cells: Cells, update: OccupancyGridUpdate): Cells | null {
  const { x, y, width, height, data } = update
  if (x < 0 || y < 0 || x + width > cells.width || y + height > cells.height || data.length !== width * height) return null
  const all = cells.data.slice()
  const rows = data instanceof Int8Array ? data : Int8Array.from(data)
  for (let row = 0; row < height; row++) {
    all.set(rows.subarray(row * width, (row + 1) * width), (y + row) * cells.width + x)
  }
  return { ...cells, data: all }
}

/** A grid of half the size. Of each four cells the occupied one counts most, the unknown one least, so thin walls stay. */
export function halved({ width, height, data }: Cells): Cells {
  const [w, h] = [Math.max(1, Math.ceil(width / 2)), Math.max(1, Math.ceil(height / 2))]
  const found = new Int8Array(w * h)
  for (let j = 0; j < h; j++) {
    const low = 2 * j * width
    const high = Math.min(2 * j + 1, height - 1) * width
    for (let i = 0; i < w; i++) {
      const left = 2 * i
      const right = left + 1 < width ? left + 1 : left
      const [a, b, c, d] = [data[low + left]!, data[low + right]!, data[high + left]!, data[high + right]!]
      const e = a > b ? a : b
      const f = c > d ? c : d
      found[j * w + i] = e > f ? e : f
    }
  }
  return { width: w, height: h, data: found }
}

/** Grids for all distances: each half as large as the one before. */
export function* levels(cells: Cells): Generator<{ cells: Cells; factor: number }> {
  let factor = 1
  for (; cells.width * cells.height > MOST_CELLS; factor *= 2) cells = halved(cells)
  yield { cells, factor }
  while (Math.max(cells.width, cells.height) > OVERVIEW) {
    cells = halved(cells)
    factor *= 2
    yield { cells, factor }
  }
}

/** The smallest rectangle with all known cells, in cells; null where all are unknown. */
export function known({ width, height, data }: Cells): Box | null {
  const box = { minX: width, minY: height, maxX: 0, maxY: 0 }
  for (let y = 0; y < height; y++) {
    const row = data.subarray(y * width, (y + 1) * width)
    const first = row.findIndex((cell) => cell >= 0)
    if (first < 0) continue
    let last = width - 1
    while (row[last]! < 0) last--
    box.minX = Math.min(box.minX, first)
    box.maxX = Math.max(box.maxX, last + 1)
    box.minY = Math.min(box.minY, y)
    box.maxY = y + 1
  }
  return box.maxY === 0 ? null : box
}

type Colour = [number, number, number, number]

const UNKNOWN: Colour = [0, 0, 0, 0]
const FREE: Colour = [38, 50, 61, 255]
const OCCUPIED: Colour = [214, 223, 230, 255]
const CHEAP: Colour = [227, 176, 82, 20]
const DEAR: Colour = [236, 122, 66, 120]
/** The robot's centre would touch something here. */
const INSCRIBED: Colour = [224, 90, 150, 140]
const LETHAL: Colour = [240, 70, 90, 175]

function between(from: Colour, to: Colour, share: number): Colour {
  return from.map((value, i) => Math.round(value + (to[i]! - value) * share)) as Colour
}

function costColour(cell: number): Colour {
  if (cell <= 0) return UNKNOWN
  if (cell >= 100) return LETHAL
  return cell === 99 ? INSCRIBED : between(CHEAP, DEAR, cell / 98)
}

/** One pixel for each of the 256 values of a cell, in the order of memory. Values above 100 count as unknown. */
export function palette(kind: GridKind): Uint32Array {
  const bytes = new Uint8ClampedArray(256 * 4)
  for (let cell = 0; cell <= 100; cell++) {
    bytes.set(kind === 'map' ? between(FREE, OCCUPIED, cell / 100) : costColour(cell), cell * 4)
  }
  return new Uint32Array(bytes.buffer)
}

/** Pixels of the cells, four bytes each, in the order of the cells: the lowest row first. */
export function pixels({ data }: Cells, colours: Uint32Array): Uint8ClampedArray<ArrayBuffer> {
  const found = new Uint32Array(data.length)
  for (let i = 0; i < data.length; i++) found[i] = colours[data[i]! & 255]!
  return new Uint8ClampedArray(found.buffer)
}
