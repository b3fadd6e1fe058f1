/** Pose and speed of an odometry message, and the path driven. Metres, radians. */
import type { Odometry } from './messages'

export interface Pose {
  x: number
  y: number
  /** Counter-clockwise from the x axis, -π to π. */
  heading: number
  /** Metres per second, backwards is negative. */
  speed: number
  /** Radians per second, left is positive. */
  turn: number
}

export function pose(message: Odometry): Pose {
  const { position: p, orientation: q } = message.pose.pose
  const { linear, angular } = message.twist.twist
  return {
    x: p.x,
    y: p.y,
    heading: Math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)),
    speed: linear.x,
    turn: angular.z,
  }
}

const SPACING_M = 0.03
const JUMP_M = 2
const LENGTH = 600

/** The path of the robot, with one point every few centimetres. */
export class Trail {
  points: [number, number][] = []

  add(x: number, y: number): void {
    if (!Number.isFinite(x) || !Number.isFinite(y)) return
    const last = this.points.at(-1)
    if (last) {
      const moved = Math.hypot(x - last[0], y - last[1])
      if (moved < SPACING_M) return
      // The odometry was reset, so a line from the old position would be wrong.
      if (moved > JUMP_M) this.points = []
    }
    this.points.push([x, y])
    if (this.points.length > LENGTH) this.points.shift()
  }
}

export interface View {
  centreX: number
  centreY: number
  /** Half the side of the square shown, metres. */
  half: number
}

/** The square that holds the trail, never narrower than 2 m. */
export function view(trail: [number, number][]): View {
  if (trail.length === 0) return { centreX: 0, centreY: 0, half: 1 }
  let [minX, minY, maxX, maxY] = [Infinity, Infinity, -Infinity, -Infinity]
  for (const [x, y] of trail) {
    minX = Math.min(minX, x)
    maxX = Math.max(maxX, x)
    minY = Math.min(minY, y)
    maxY = Math.max(maxY, y)
  }
  return {
    centreX: (minX + maxX) / 2,
    centreY: (minY + maxY) / 2,
    half: Math.max(1, (Math.max(maxX - minX, maxY - minY) / 2) * 1.15),
  }
}
