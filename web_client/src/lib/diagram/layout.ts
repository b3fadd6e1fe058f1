/** Where robots and Roles stand in the diagram when the user has not moved them. */

export interface Box {
  id: string
  role: boolean
  /** Rows that it shows. */
  rows: number
  /** Lines that begin and end at it. */
  out: number
  in: number
}

export interface Point {
  x: number
  y: number
}

export const WIDTH = 300
const GAP = { x: 130, y: 32 }
const HEAD = 52
const ROW = 30

/** Column of each box: 0 for sources, 1 for targets, 2 for Roles, which are out of the way of pipes.
 *
 * @param kept columns that stay, so that a new line moves nothing
 */
export function columnsOf(boxes: Box[], kept: Record<string, number> = {}): Record<string, number> {
  const columns = { ...kept }
  const heights = [0, 0, 0]
  for (const box of boxes) {
    const column = kept[box.id] ?? columnOf(box, heights)
    columns[box.id] = column
    heights[column]! += box.rows + 2
  }
  return columns
}

function columnOf(box: Box, heights: number[]): number {
  if (box.role) return 2
  if (box.in !== box.out) return box.in > box.out ? 1 : 0
  return heights[0]! <= heights[1]! ? 0 : 1
}

/** Positions of all boxes, by their columns. Empty columns take no room.
 *
 * @param moved positions that the user has chosen
 * @param narrow whether all stand in one column, for a phone
 */
export function layout(boxes: Box[], columns: Record<string, number>, moved: Record<string, Point> = {}, narrow = false): Record<string, Point> {
  const used = [0, 1, 2].filter((column) => boxes.some(({ id }) => columns[id] === column))
  const heights = [0, 0, 0]
  const found: Record<string, Point> = {}
  for (const { id, rows } of boxes) {
    const column = narrow ? 0 : (columns[id] ?? 0)
    found[id] = moved[id] ?? { x: Math.max(0, used.indexOf(column)) * (WIDTH + GAP.x), y: heights[column]! }
    heights[column]! += HEAD + rows * ROW + GAP.y
  }
  return found
}
