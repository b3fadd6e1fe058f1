/** What the map shows: grids, scan, path, pose and trail of one robot, in one frame. */
import { cellsOf, type Cells, type GridKind, patched } from '../map/grid'
import { GridPainter } from '../map/gridPainter'
import type { GridPicture, GridPlace } from '../map/gridWorker'
import type { Point } from '../map/viewport'
import type { Header, LaserScan, OccupancyGrid, OccupancyGridUpdate, Odometry, Path, TransformMessage } from '../ros/messages'
import { Trail } from '../ros/odometry'
import { isStale } from '../ros/rateMeter'
import { points } from '../ros/scan'
import { apply, baseFrame, fixedFrame, flat, frameName, type Pose2, seconds, TransformSearch, TransformTree } from '../ros/transforms'
import { recall, remember } from './storage'

/** What is drawn; `costmap` is the name of a topic, empty for none. */
export interface Layers {
  map: boolean
  costmap: string
  scan: boolean
  plan: boolean
  trail: boolean
}

const USUAL: Layers = { map: true, costmap: '', scan: true, plan: true, trail: true }

const NO_HEADER: Header = { frame_id: '', stamp: { sec: 0, nanosec: 0 } }

/** One grid topic: its newest message as a picture. */
export class GridLayer {
  picture = $state.raw<GridPicture | null>(null)
  /** Why the newest message is not drawn. */
  failed = $state<string | null>(null)
  /** Frame of the newest message, also while the grid is not shown; null before the first. */
  frame = $state<string | null>(null)

  private cells: Cells | null = null
  private place: GridPlace | null = null
  private readonly painter: GridPainter

  constructor(private readonly kind: GridKind) {
    this.painter = new GridPainter(
      (picture) => this.show(picture),
      (reason) => (this.failed = reason),
    )
  }

  take({ header = NO_HEADER, info, data }: OccupancyGrid): void {
    try {
      this.cells = cellsOf({ info, data })
      this.place = { frame: header.frame_id || 'map', resolution: info.resolution, origin: flatOrigin(info.origin) }
    } catch (error) {
      this.failed = error instanceof Error ? error.message : String(error)
      return
    }
    this.failed = null
    this.frame = header.frame_id || 'map'
    this.paint()
  }

  update(update: OccupancyGridUpdate): void {
    const cells = this.cells === null ? null : patched(this.cells, update)
    if (cells === null) return
    this.cells = cells
    this.paint()
  }

  clear(): void {
    this.painter.close()
    this.cells = this.place = this.failed = null
    this.show(null)
  }

  private paint(): void {
    if (this.cells !== null && this.place !== null) this.painter.paint({ kind: this.kind, cells: this.cells, place: this.place })
  }

  private show(picture: GridPicture | null): void {
    for (const { bitmap } of this.picture?.levels ?? []) bitmap.close()
    this.picture = picture
  }
}

function flatOrigin({ position, orientation }: OccupancyGrid['info']['origin']): Pose2 {
  return flat({ translation: position, rotation: orientation })
}

export class MapStore {
  layers = $state.raw<Layers>(USUAL)
  /** The frame in which all points are. */
  fixed = $state('')
  robot = $state.raw<Pose2 | null>(null)
  robotMs = $state<number | null>(null)
  scan = $state.raw<Float32Array>(new Float32Array())
  scanMs = $state<number | null>(null)
  /** The scan's frame if it is not connected to the robot's: the scan is drawn as if it were. */
  looseScan = $state<string | null>(null)
  plan = $state.raw<Point[]>([])
  planMs = $state<number | null>(null)
  /** Whether transforms are received unthrottled. */
  searching = $state(false)

  readonly map = new GridLayer('map')
  readonly costmap = new GridLayer('costmap')
  readonly tree = new TransformTree()
  trail = new Trail()

  private base = 'base_link'
  /** Whether the robot's pose in its parent frame comes from the odometry. */
  private fromOdometry = false
  private odom: string | null = null
  private scanFrame: string | null = null
  private waiting: LaserScan | null = null
  private readonly search = new TransformSearch()

  constructor(private readonly name: string) {
    this.layers = recall<Layers>(`map:${name}`, USUAL)
  }

  close(): void {
    this.map.clear()
    this.costmap.clear()
  }

  setLayers(change: Partial<Layers>): void {
    this.layers = { ...this.layers, ...change }
    remember(`map:${this.name}`, this.layers)
  }

  takeMap(map: OccupancyGrid): void {
    this.map.take(map)
    this.moved()
  }

  takeTransforms({ transforms }: TransformMessage, isStatic: boolean): void {
    const atMs = isStatic ? Infinity : performance.now()
    for (const { header, child_frame_id, transform } of transforms) {
      this.tree.set(header.frame_id, child_frame_id, transform, atMs, seconds(header.stamp))
      if (frameName(child_frame_id) === this.base) this.fromOdometry = false
    }
    this.moved()
  }

  takeOdometry({ header = NO_HEADER, child_frame_id = '', pose }: Odometry): void {
    const now = performance.now()
    this.odom = header.frame_id || 'odom'
    this.base = baseFrame(this.tree, child_frame_id)
    // Transforms may come from a filter that is better than the odometry, so it only fills their gaps.
    if (this.fromOdometry || isStale(this.tree.receivedMs(this.base), now)) {
      const { position, orientation } = pose.pose
      this.tree.set(this.odom, this.base, { translation: position, rotation: orientation }, now, seconds(header.stamp))
      this.fromOdometry = true
    }
    this.moved()
  }

  /** A scan waits for a pose that is not older than it: a robot that turns would see walls turned. */
  takeScan(scan: LaserScan): void {
    if (this.waiting !== null) this.place(this.waiting)
    this.waiting = scan
    this.scanFrame = scan.header?.frame_id || null
    this.scanMs = performance.now()
    // Without a pose the robot is the centre.
    if (this.robotMs === null) this.moved()
    else this.placeWaiting()
  }

  private placeWaiting(): void {
    const scan = this.waiting
    if (scan === null || (this.tree.stampS(this.base) ?? Infinity) < seconds((scan.header ?? NO_HEADER).stamp)) return
    this.waiting = null
    this.place(scan)
  }

  private place(scan: LaserScan): void {
    const { frame_id: frame, stamp } = scan.header ?? NO_HEADER
    const timeS = seconds(stamp)
    const toFixed = this.tree.lookup(this.fixed, frame, timeS) ?? this.tree.lookup(this.fixed, this.base, timeS)
    this.looseScan = frame !== '' && this.tree.lookup(this.base, frame) === null ? frame : null
    const found = toFixed === null ? new Float32Array() : points(scan)
    for (let i = 0; toFixed !== null && i < found.length; i += 2) {
      const { x, y } = apply(toFixed, { x: found[i]!, y: found[i + 1]!, z: 0 })
      found[i] = x
      found[i + 1] = y
    }
    this.scan = found
  }

  takePlan({ header = NO_HEADER, poses }: Path): void {
    const toFixed = this.tree.lookup(this.fixed, header.frame_id || this.fixed)
    this.plan = toFixed === null ? [] : poses.map(({ pose }) => apply(toFixed, pose.position))
    this.planMs = performance.now()
  }

  /** The goal of the path is over. */
  forgetPlan(): void {
    this.plan = []
  }

  /** Looks for missing or old transforms; called a few times a second. */
  tick(nowMs: number): void {
    const chains = [this.map.frame ?? this.odom, this.scanFrame].filter((frame): frame is string => frame !== null)
    const ages = chains.map((frame) => this.tree.oldestMs(frame, this.base))
    const oldest = ages.some((age) => age === null) ? null : Math.min(Infinity, ...(ages as number[]))
    this.searching = this.search.isOn(oldest, nowMs)
  }

  private moved(): void {
    const fixed = fixedFrame(this.tree, this.map.frame, this.odom, this.base)
    if (fixed !== this.fixed) this.changeFrame(fixed)
    this.placeWaiting()
    const found = this.tree.lookup(fixed, this.base)
    if (found === null) {
      this.robot = null
      return
    }
    this.robot = flat(found)
    this.robotMs = Math.min(this.tree.receivedMs(this.base) ?? Infinity, performance.now())
    this.trail.add(this.robot.x, this.robot.y)
  }

  /** Points of the former frame mean nothing in another. */
  private changeFrame(fixed: string): void {
    this.fixed = fixed
    this.trail = new Trail()
    this.scan = new Float32Array()
    this.plan = []
  }
}
