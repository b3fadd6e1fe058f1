/** The part of the plane that the map shows, and gestures on it. World: metres, y up. Screen: CSS pixels, y down. */
import type { Pose2 } from '../ros/transforms'
import type { Box } from './grid'

export interface Point {
  x: number
  y: number
}

export interface Viewport {
  /** World point in the centre of the screen. */
  centre: Point
  /** Pixels per metre. */
  scale: number
}

export interface Size {
  width: number
  height: number
}

export const SCALES = { least: 0.5, most: 1000 }
const MARGIN_PX = 24
/** A drag shorter than this is a press. */
const DRAG_PX = 10

function bounded(scale: number): number {
  return Math.max(SCALES.least, Math.min(SCALES.most, scale))
}

export function toScreen({ centre, scale }: Viewport, { width, height }: Size, { x, y }: Point): Point {
  return { x: width / 2 + (x - centre.x) * scale, y: height / 2 - (y - centre.y) * scale }
}

export function toWorld({ centre, scale }: Viewport, { width, height }: Size, { x, y }: Point): Point {
  return { x: centre.x + (x - width / 2) / scale, y: centre.y - (y - height / 2) / scale }
}

/** Moves the content by pixels. */
export function panned({ centre, scale }: Viewport, dx: number, dy: number): Viewport {
  return { centre: { x: centre.x - dx / scale, y: centre.y + dy / scale }, scale }
}

/** Enlarges by a factor; the world point under `at` stays there. */
export function zoomed(view: Viewport, size: Size, at: Point, factor: number): Viewport {
  const fixed = toWorld(view, size, at)
  const scale = bounded(view.scale * factor)
  const moved = toScreen({ ...view, scale }, size, fixed)
  return panned({ ...view, scale }, at.x - moved.x, at.y - moved.y)
}

/** Follows two fingers: the world points that they touched stay below them. */
export function pinched(view: Viewport, size: Size, before: [Point, Point], after: [Point, Point]): Viewport {
  const middle = ([a, b]: [Point, Point]) => ({ x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 })
  const span = ([a, b]: [Point, Point]) => Math.max(1, Math.hypot(a.x - b.x, a.y - b.y))
  const [from, to] = [middle(before), middle(after)]
  return zoomed(panned(view, to.x - from.x, to.y - from.y), size, to, span(after) / span(before))
}

/** Shows a rectangle of the world as large as possible. */
export function fitted(box: Box, { width, height }: Size): Viewport {
  const [w, h] = [Math.max(box.maxX - box.minX, 1), Math.max(box.maxY - box.minY, 1)]
  const scale = Math.min(Math.max(width - 2 * MARGIN_PX, 1) / w, Math.max(height - 2 * MARGIN_PX, 1) / h)
  return { centre: { x: (box.minX + box.maxX) / 2, y: (box.minY + box.maxY) / 2 }, scale: bounded(scale) }
}

/** The rectangle around points, null without any. */
export function around(points: Iterable<Point>): Box | null {
  const box = { minX: Infinity, minY: Infinity, maxX: -Infinity, maxY: -Infinity }
  for (const { x, y } of points) {
    box.minX = Math.min(box.minX, x)
    box.minY = Math.min(box.minY, y)
    box.maxX = Math.max(box.maxX, x)
    box.maxY = Math.max(box.maxY, y)
  }
  return box.minX > box.maxX ? null : box
}

/** The goal of a press and a drag, in the world: the press is the position, the direction of the drag is the heading.
 *
 * Without a drag the robot arrives facing away from where it is now.
 */
export function goalPose(view: Viewport, size: Size, pressed: Point, now: Point, robot: Pose2 | null): Pose2 {
  const { x, y } = toWorld(view, size, pressed)
  const [dx, dy] = [now.x - pressed.x, pressed.y - now.y]
  if (Math.hypot(dx, dy) >= DRAG_PX) return { x, y, heading: Math.atan2(dy, dx) }
  return { x, y, heading: robot === null ? 0 : Math.atan2(y - robot.y, x - robot.x) }
}

const STEPS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500]

/** Distance in metres of the lines of the background, and length of the scale bar. */
export function gridStep(scale: number): number {
  return STEPS.find((step) => step * scale >= 40) ?? STEPS.at(-1)!
}
