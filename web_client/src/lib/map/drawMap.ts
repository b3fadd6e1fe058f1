/** Draws the map: grids, scan, path, trail, robot and goal. */
import { arrow, INK, type Surface } from '../canvas'
import type { Pose2, TransformTree } from '../ros/transforms'
import { flat } from '../ros/transforms'
import type { Box } from './grid'
import type { GridLevel, GridPicture } from './gridWorker'
import { gridStep, type Point, toScreen, toWorld, type Viewport } from './viewport'

export interface Scene {
  view: Viewport
  /** The frame of all points below. */
  fixed: string
  tree: TransformTree
  map: GridPicture | null
  costmap: GridPicture | null
  /** Pairs x, y. */
  scan: Float32Array
  scanStale: boolean
  plan: Point[]
  planStale: boolean
  trail: [number, number][]
  robot: Pose2 | null
  robotStale: boolean
  goal: Pose2 | null
  /** A list that is being set or driven. */
  targets: Pose2[]
  /** The goal that is being set. */
  draft: Pose2 | null
}

export function drawMap(surface: Surface, scene: Scene): void {
  const { context: c, width, height } = surface
  c.fillStyle = INK.ground
  c.fillRect(0, 0, width, height)
  for (const picture of [scene.map, scene.costmap]) if (picture !== null) drawGrid(surface, scene, picture)
  drawLines(surface, scene.view)
  drawLine(surface, scene.view, scene.trail.map(([x, y]) => ({ x, y })), INK.accent, 0.55)
  drawLine(surface, scene.view, scene.plan, INK.path, scene.planStale ? 0.35 : 1)
  drawScan(surface, scene)
  for (const target of scene.targets) drawGoal(surface, scene.view, target, INK.path)
  if (scene.goal !== null) drawGoal(surface, scene.view, scene.goal, INK.goal)
  if (scene.robot !== null) drawRobot(surface, scene.view, scene.robot, scene.robotStale)
  if (scene.draft !== null) drawGoal(surface, scene.view, scene.draft, INK.path)
  drawScaleBar(surface, scene.view)
}

/** The level of a grid whose pixels are nearest to those of the screen, but not larger. */
export function levelFor(levels: GridLevel[], pixelsPerCell: number): GridLevel {
  const fine = levels.filter(({ factor }) => factor * pixelsPerCell <= 1)
  return fine.at(-1) ?? levels[0]!
}

/** Corners of the known part of a grid, or of all of it, in the fixed frame; null where its frame is not connected. */
export function extent(picture: GridPicture, fixed: string, tree: TransformTree): Point[] | null {
  const found = tree.lookup(fixed, picture.place.frame)
  if (found === null) return null
  const { resolution, origin } = picture.place
  const { bitmap, factor } = picture.levels[0]!
  const all: Box = { minX: 0, minY: 0, maxX: bitmap.width * factor, maxY: bitmap.height * factor }
  const box = picture.known ?? all
  const corners: [number, number][] = [
    [box.minX, box.minY],
    [box.maxX, box.minY],
    [box.maxX, box.maxY],
    [box.minX, box.maxY],
  ]
  return corners.map(([x, y]) => placed(flat(found), placed(origin, { x: x * resolution, y: y * resolution })))
}

function placed({ x, y, heading }: Pose2, point: Point): Point {
  const [c, s] = [Math.cos(heading), Math.sin(heading)]
  return { x: x + c * point.x - s * point.y, y: y + s * point.x + c * point.y }
}

function drawGrid({ context: c, width, height }: Surface, { view, fixed, tree }: Scene, picture: GridPicture): void {
  const found = tree.lookup(fixed, picture.place.frame)
  if (found === null) return
  const frame = flat(found)
  const { resolution, origin } = picture.place
  const { bitmap, factor } = levelFor(picture.levels, resolution * view.scale * (window.devicePixelRatio || 1))
  const at = toScreen(view, { width, height }, placed(frame, origin))
  const side = resolution * factor * view.scale
  c.save()
  c.translate(at.x, at.y)
  c.rotate(-(frame.heading + origin.heading))
  // The first row of the bitmap is the lowest of the grid.
  c.scale(side, -side)
  c.imageSmoothingEnabled = side < 1
  c.drawImage(bitmap, 0, 0)
  c.restore()
}

function drawLines(surface: Surface, view: Viewport): void {
  const { context: c, width, height } = surface
  const step = gridStep(view.scale)
  const low = toWorld(view, surface, { x: 0, y: height })
  const high = toWorld(view, surface, { x: width, y: 0 })
  c.save()
  c.globalAlpha = 0.45
  c.strokeStyle = INK.line
  c.lineWidth = 1
  c.beginPath()
  for (let x = Math.ceil(low.x / step) * step; x <= high.x; x += step) {
    const px = toScreen(view, surface, { x, y: 0 }).x
    c.moveTo(px, 0)
    c.lineTo(px, height)
  }
  for (let y = Math.ceil(low.y / step) * step; y <= high.y; y += step) {
    const py = toScreen(view, surface, { x: 0, y }).y
    c.moveTo(0, py)
    c.lineTo(width, py)
  }
  c.stroke()
  c.restore()
}

function drawLine(surface: Surface, view: Viewport, points: Point[], colour: string, alpha: number): void {
  if (points.length < 2) return
  const c = surface.context
  c.save()
  c.globalAlpha = alpha
  c.strokeStyle = colour
  c.lineWidth = 2
  c.lineJoin = 'round'
  c.beginPath()
  for (const [i, point] of points.entries()) {
    const { x, y } = toScreen(view, surface, point)
    if (i === 0) c.moveTo(x, y)
    else c.lineTo(x, y)
  }
  c.stroke()
  c.restore()
}

function drawScan(surface: Surface, { view, scan, scanStale }: Scene): void {
  const c = surface.context
  c.fillStyle = scanStale ? INK.stale : INK.accent
  for (let i = 0; i < scan.length; i += 2) {
    const { x, y } = toScreen(view, surface, { x: scan[i]!, y: scan[i + 1]! })
    c.fillRect(x - 1.25, y - 1.25, 2.5, 2.5)
  }
}

function drawRobot(surface: Surface, view: Viewport, robot: Pose2, stale: boolean): void {
  const { x, y } = toScreen(view, surface, robot)
  const c = surface.context
  c.fillStyle = 'rgb(14 19 24 / 75%)'
  c.strokeStyle = stale ? INK.stale : INK.accent
  c.lineWidth = 2
  c.beginPath()
  c.arc(x, y, 13, 0, 2 * Math.PI)
  c.fill()
  c.stroke()
  arrow(c, x, y, robot.heading, 9, stale ? INK.stale : INK.robot)
}

function drawGoal(surface: Surface, view: Viewport, goal: Pose2, colour: string): void {
  const { x, y } = toScreen(view, surface, goal)
  const c = surface.context
  c.save()
  c.translate(x, y)
  c.rotate(-goal.heading)
  c.strokeStyle = c.fillStyle = colour
  c.lineWidth = 3
  c.beginPath()
  c.arc(0, 0, 7, 0, 2 * Math.PI)
  c.moveTo(7, 0)
  c.lineTo(28, 0)
  c.stroke()
  c.beginPath()
  c.moveTo(38, 0)
  c.lineTo(26, 7)
  c.lineTo(26, -7)
  c.closePath()
  c.fill()
  c.restore()
}

function drawScaleBar({ context: c, height }: Surface, view: Viewport): void {
  const step = gridStep(view.scale)
  const length = step * view.scale
  const [x, y] = [12, height - 12]
  c.strokeStyle = c.fillStyle = INK.text
  c.lineWidth = 2
  c.beginPath()
  c.moveTo(x, y - 5)
  c.lineTo(x, y)
  c.lineTo(x + length, y)
  c.lineTo(x + length, y - 5)
  c.stroke()
  c.font = '11px system-ui, sans-serif'
  c.fillText(step < 1 ? `${Math.round(step * 100)} cm` : `${step} m`, x + 5, y - 6)
}
