/** Turns grids into bitmaps, off the page's thread: one of 4,000 × 4,000 cells takes longer than a frame. */
import type { Pose2 } from '../ros/transforms'
import { type Box, type Cells, type GridKind, known, levels, palette, pixels } from './grid'

/** Where a grid lies. */
export interface GridPlace {
  frame: string
  /** Metres along a side of a cell. */
  resolution: number
  /** Pose of the lower left corner in the frame. */
  origin: Pose2
}

export interface GridJob {
  kind: GridKind
  cells: Cells
  place: GridPlace
}

export interface GridLevel {
  bitmap: ImageBitmap
  /** Cells of the grid along one side of a pixel. */
  factor: number
}

export interface GridPicture {
  place: GridPlace
  levels: GridLevel[]
  /** The known part, in cells. */
  known: Box | null
}

const PALETTES = { map: palette('map'), costmap: palette('costmap') }

async function draw({ kind, cells, place }: GridJob): Promise<GridPicture> {
  const found: GridLevel[] = []
  for (const { cells: each, factor } of levels(cells)) {
    const image = new ImageData(pixels(each, PALETTES[kind]), each.width, each.height)
    found.push({ bitmap: await createImageBitmap(image), factor })
  }
  return { place, levels: found, known: known(cells) }
}

const port = self as unknown as {
  onmessage: (event: MessageEvent<GridJob>) => void
  postMessage(message: GridPicture | { failed: string }, transfer: Transferable[]): void
}

port.onmessage = ({ data }) => {
  draw(data).then(
    (picture) => port.postMessage(picture, picture.levels.map(({ bitmap }) => bitmap)),
    (error: unknown) => port.postMessage({ failed: String(error) }, []),
  )
}
