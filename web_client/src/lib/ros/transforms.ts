/** Coordinate frames of a robot (REP 105): transforms, their composition, and the tree of them. Metres, radians. */
import type { Quaternion, Time, Transform, Vector3 } from './messages'

export interface Pose2 {
  x: number
  y: number
  /** Counter-clockwise from the x axis, -π to π. */
  heading: number
}

export const IDENTITY: Transform = {
  translation: { x: 0, y: 0, z: 0 },
  rotation: { x: 0, y: 0, z: 0, w: 1 },
}

/** A hostile robot must not fill the memory. */
const MOST_FRAMES = 1000

export function rotate(q: Quaternion, v: Vector3): Vector3 {
  // v + 2w(u × v) + 2u × (u × v), where u is the vector part.
  const tx = 2 * (q.y * v.z - q.z * v.y)
  const ty = 2 * (q.z * v.x - q.x * v.z)
  const tz = 2 * (q.x * v.y - q.y * v.x)
  return {
    x: v.x + q.w * tx + q.y * tz - q.z * ty,
    y: v.y + q.w * ty + q.z * tx - q.x * tz,
    z: v.z + q.w * tz + q.x * ty - q.y * tx,
  }
}

/** A point of the child frame in the parent frame. */
export function apply(t: Transform, point: Vector3): Vector3 {
  const turned = rotate(t.rotation, point)
  return { x: turned.x + t.translation.x, y: turned.y + t.translation.y, z: turned.z + t.translation.z }
}

/** The transform that applies `inner` first, then `outer`. */
export function compose(outer: Transform, inner: Transform): Transform {
  const [a, b] = [outer.rotation, inner.rotation]
  return {
    translation: apply(outer, inner.translation),
    rotation: {
      x: a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
      y: a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
      z: a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
      w: a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
    },
  }
}

export function invert({ translation: t, rotation: q }: Transform): Transform {
  const rotation = { x: -q.x, y: -q.y, z: -q.z, w: q.w }
  return { translation: rotate(rotation, { x: -t.x, y: -t.y, z: -t.z }), rotation }
}

/** A stamp or a duration in seconds. */
export function seconds({ sec, nanosec }: Time): number {
  return sec + nanosec / 1e9
}

/** Between two transforms of the same frames; `share` 0 is the first, 1 the second. */
export function between(a: Transform, b: Transform, share: number): Transform {
  const [p, q, from] = [a.translation, b.translation, a.rotation]
  // A quaternion and its negative are the same rotation; the nearer one is meant.
  const dot = from.x * b.rotation.x + from.y * b.rotation.y + from.z * b.rotation.z + from.w * b.rotation.w
  const mix = (u: number, v: number) => u + ((dot < 0 ? -v : v) - u) * share
  const mixed = [mix(from.x, b.rotation.x), mix(from.y, b.rotation.y), mix(from.z, b.rotation.z), mix(from.w, b.rotation.w)] as const
  const length = Math.hypot(...mixed)
  const [x, y, z, w] = mixed.map((value) => value / length) as [number, number, number, number]
  return {
    translation: { x: p.x + (q.x - p.x) * share, y: p.y + (q.y - p.y) * share, z: p.z + (q.z - p.z) * share },
    rotation: { x, y, z, w },
  }
}

/** The angle around the vertical axis. */
export function yaw({ x, y, z, w }: Quaternion): number {
  return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
}

export function fromYaw(heading: number): Quaternion {
  return { x: 0, y: 0, z: Math.sin(heading / 2), w: Math.cos(heading / 2) }
}

/** Seen from above. */
export function flat(t: Transform): Pose2 {
  return { x: t.translation.x, y: t.translation.y, heading: yaw(t.rotation) }
}

function isFinite(t: Transform): boolean {
  return [...Object.values(t.translation), ...Object.values(t.rotation)].every(Number.isFinite)
}

/** tf2 removed the leading slash of frame names; some drivers still send it. */
export function frameName(name: string): string {
  return name.replace(/^\/+/, '')
}

interface Edge {
  parent: string
  transform: Transform
  /** When it was received, by the page's clock; Infinity for a static one. */
  atMs: number
  /** Its stamp, by the robot's clock, seconds. */
  stampS: number
  /** The one before it. */
  before: { transform: Transform; stampS: number } | null
}

/** A stamp that is this much older than the known transforms is of another clock, seconds. */
const FOREIGN_S = 1

/** The transform at a time: between the last two of them, or the newest. */
function at({ transform, stampS, before }: Edge, timeS: number): Transform {
  if (before === null || timeS >= stampS || timeS < before.stampS - FOREIGN_S) return transform
  return between(before.transform, transform, Math.max(0, (timeS - before.stampS) / (stampS - before.stampS)))
}

/** The frames of one robot, each with its newest transform to its parent. */
export class TransformTree {
  private readonly edges = new Map<string, Edge>()

  /**
   * @param atMs when it was received, by the page's clock; Infinity for a static transform
   * @param stampS its stamp, by the robot's clock, seconds
   */
  set(parent: string, child: string, transform: Transform, atMs: number, stampS = 0): void {
    const [from, to] = [frameName(parent), frameName(child)]
    if (from === '' || to === '' || from === to || !isFinite(transform)) return
    if (this.edges.size >= MOST_FRAMES && !this.edges.has(to)) return
    const last = this.edges.get(to)
    const follows = last !== undefined && last.parent === from && stampS > last.stampS
    // One that comes twice leaves the one before it.
    const same = last !== undefined && last.parent === from && stampS === last.stampS
    const before = follows ? { transform: last.transform, stampS: last.stampS } : same ? last.before : null
    this.edges.set(to, { parent: from, transform, atMs, stampS, before })
  }

  clear(): void {
    this.edges.clear()
  }

  /** When the transform of a frame to its parent was received; null without one. */
  receivedMs(child: string): number | null {
    return this.edges.get(frameName(child))?.atMs ?? null
  }

  /** Stamp of the transform of a frame to its parent, seconds; null without one. */
  stampS(child: string): number | null {
    return this.edges.get(frameName(child))?.stampS ?? null
  }

  has(frame: string): boolean {
    const name = frameName(frame)
    return this.edges.has(name) || Array.from(this.edges.values()).some((edge) => edge.parent === name)
  }

  /** The transform of points in `source` to `target`; null where the frames are not connected.
   *
   * @param timeS when, by the robot's clock; the newest without it
   */
  lookup(target: string, source: string, timeS = Infinity): Transform | null {
    const [to, from] = [frameName(target), frameName(source)]
    if (to === from) return IDENTITY
    const down = this.ancestors(to, timeS)
    const up = this.ancestors(from, timeS)
    for (const [frame, fromSource] of up) {
      const fromTarget = down.get(frame)
      if (fromTarget !== undefined) return compose(invert(fromTarget), fromSource)
    }
    return null
  }

  /** When the oldest transform between two frames was received; null where they are not connected. */
  oldestMs(target: string, source: string): number | null {
    const [to, from] = [this.ancestors(frameName(target)), this.ancestors(frameName(source))]
    const common = Array.from(from.keys()).find((frame) => to.has(frame))
    if (common === undefined) return null
    let oldest = Infinity
    for (const chain of [to, from]) {
      for (const frame of chain.keys()) {
        if (frame === common) break
        oldest = Math.min(oldest, this.edges.get(frame)?.atMs ?? Infinity)
      }
    }
    return oldest
  }

  /** The frame and all above it, nearest first, each with the transform of the frame's points to it. */
  private ancestors(frame: string, timeS = Infinity): Map<string, Transform> {
    const found = new Map<string, Transform>([[frame, IDENTITY]])
    let [name, transform] = [frame, IDENTITY]
    for (;;) {
      const edge = this.edges.get(name)
      // Two publishers that contradict each other can make a circle.
      if (edge === undefined || found.has(edge.parent)) return found
      transform = compose(at(edge, timeS), transform)
      name = edge.parent
      found.set(name, transform)
    }
  }
}

const BASES = ['base_link', 'base_footprint']

/** The frame of the robot's body.
 *
 * @param said `child_frame_id` of the odometry, empty without one
 */
export function baseFrame(tree: TransformTree, said: string): string {
  return said !== '' ? frameName(said) : (BASES.find((name) => tree.has(name)) ?? BASES[0]!)
}

/** The frame in which everything is drawn: the map's, even if the robot is not on it yet, else `map`, else that of the odometry.
 *
 * @param map frame of the map shown, null without a map
 * @param odom frame of the odometry, null without it
 */
export function fixedFrame(tree: TransformTree, map: string | null, odom: string | null, base: string): string {
  if (map !== null) return frameName(map)
  const wanted = ['map', odom, 'odom'].filter((name): name is string => name !== null && name !== '')
  return frameName(wanted.find((name) => tree.lookup(name, base) !== null) ?? base)
}

const OUTDATED_MS = 1000
const SEARCH_MS = 1000
const FIRST_PAUSE_MS = 2000
const LONGEST_PAUSE_MS = 30_000

/** Decides when transforms are received unthrottled.
 *
 * All publishers of `/tf` share it, so a throttle that lets the newest message through may always drop the same publisher.
 * If a transform that is needed is missing or old, all of them are received for a moment. What never comes is searched for
 * at growing intervals.
 */
export class TransformSearch {
  private untilMs = -Infinity
  private nextMs = -Infinity
  private pauseMs = FIRST_PAUSE_MS

  /** @param oldestMs when the oldest needed transform was received; null if one is missing */
  isOn(oldestMs: number | null, nowMs: number): boolean {
    if (oldestMs !== null && nowMs - oldestMs <= OUTDATED_MS) {
      this.untilMs = this.nextMs = -Infinity
      this.pauseMs = FIRST_PAUSE_MS
      return false
    }
    if (nowMs < this.untilMs) return true
    if (nowMs < this.nextMs) return false
    this.untilMs = nowMs + SEARCH_MS
    this.nextMs = this.untilMs + this.pauseMs
    this.pauseMs = Math.min(LONGEST_PAUSE_MS, this.pauseMs * 2)
    return true
  }
}
