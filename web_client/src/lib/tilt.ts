/** A phone that is tilted as an input: only while a button on the screen is held. Angles in degrees. */

/** A phone tells how it is held some sixty times a second; after so long without a word nobody knows. */
export const SILENT_MS = 300
export const DEAD_ANGLE = 4
export const FULL_ANGLE = 25

/** What is used of the browser's `DeviceOrientationEvent`. */
export interface Orientation {
  beta: number | null
  gamma: number | null
}

interface Pose {
  /** How far the upper edge of the screen is above the lower one. */
  pitch: number
  /** How far the right edge is below the left one. */
  roll: number
}

const RADIAN = Math.PI / 180

/** How the screen is held.
 *
 * @param screenAngle by how much the picture is turned on the phone, clockwise, as `screen.orientation.angle` says
 * @returns null where the phone does not tell
 */
export function poseOf({ beta, gamma }: Orientation, screenAngle: number): Pose | null {
  if (beta === null || gamma === null || !Number.isFinite(beta) || !Number.isFinite(gamma)) return null
  const [b, g, a] = [beta * RADIAN, gamma * RADIAN, screenAngle * RADIAN]
  // Where down is, seen from the phone (DeviceOrientation, W3C, section 4.1), then from the picture on it.
  const [x, y, z] = [Math.cos(b) * Math.sin(g), -Math.sin(b), -Math.cos(b) * Math.cos(g)]
  const right = x * Math.cos(a) - y * Math.sin(a)
  const up = x * Math.sin(a) + y * Math.cos(a)
  return { pitch: Math.atan2(-up, -z) / RADIAN, roll: Math.asin(Math.max(-1, Math.min(1, right))) / RADIAN }
}

/** Which way the phone was tilted since it was taken hold of. */
export function steering(now: Pose, neutral: Pose): { turn: number; ahead: number } {
  const pitched = ((now.pitch - neutral.pitch + 540) % 360) - 180
  return { turn: share(neutral.roll - now.roll), ahead: share(-pitched) }
}

function share(angle: number): number {
  const beyond = Math.max(0, Math.abs(angle) - DEAD_ANGLE) / (FULL_ANGLE - DEAD_ANGLE)
  return Math.sign(angle) * Math.min(1, beyond) + 0
}

/** What the phone steers. */
export interface Wheel {
  grab(): boolean
  steer(turn: number, ahead: number): void
  release(): void
  silent(): void
}

/** A button that is held, and a phone that is tilted meanwhile. */
export class TiltDriver {
  private latest: { pose: Pose; atMs: number } | null = null
  private neutral: Pose | null = null

  constructor(private readonly wheel: Wheel) {}

  get isHeld(): boolean {
    return this.neutral !== null
  }

  /** The button was pressed: as the phone is held now is standing still. Returns whether it drives. */
  press(nowMs: number): boolean {
    if (this.latest === null || nowMs - this.latest.atMs > SILENT_MS) {
      this.wheel.silent()
      return false
    }
    if (!this.wheel.grab()) return false
    this.neutral = this.latest.pose
    return true
  }

  lift(): void {
    if (this.neutral === null) return
    this.neutral = null
    this.wheel.release()
  }

  /** Driving ended for another reason: the button has to be pressed anew. */
  letGo(): void {
    this.neutral = null
  }

  /** The phone told how it is held; without angles it says nothing. */
  told(event: Orientation, screenAngle: number, nowMs: number): void {
    const pose = poseOf(event, screenAngle)
    if (pose === null) return
    this.latest = { pose, atMs: nowMs }
    if (this.neutral === null) return
    const { turn, ahead } = steering(pose, this.neutral)
    this.wheel.steer(turn, ahead)
  }

  tick(nowMs: number): void {
    if (this.neutral === null || this.latest === null || nowMs - this.latest.atMs <= SILENT_MS) return
    this.neutral = null
    this.wheel.silent()
  }
}

/** Why a phone can't be tilted here, or null.
 *
 * @param page what is used of `window`
 */
export function whyNoTilt(page: { isSecureContext: boolean; DeviceOrientationEvent?: unknown }): string | null {
  if (!page.isSecureContext) return 'A browser tells how it is held over https only.'
  return page.DeviceOrientationEvent === undefined ? 'This browser does not tell how it is held.' : null
}

/** Asks the user's leave where that is needed (iOS). Has to be called from a tap. */
export async function askLeave(kind: unknown): Promise<boolean> {
  const ask = (kind as { requestPermission?: () => Promise<string> } | undefined)?.requestPermission
  if (ask === undefined) return true
  try {
    return (await ask.call(kind)) === 'granted'
  } catch {
    return false
  }
}
