/** The tilt of a phone as an input. It drives only while a button on the screen is held. Angles in degrees. */

/** Time without an event after which the orientation is unknown, milliseconds. Phones report it about 60 times a second. */
export const SILENT_MS = 300
export const DEAD_ANGLE = 4
export const FULL_ANGLE = 25

/** The used part of the browser's `DeviceOrientationEvent`. */
export interface Orientation {
  beta: number | null
  gamma: number | null
}

interface Pose {
  /** Angle by which the upper edge of the screen is above the lower one. */
  pitch: number
  /** Angle by which the right edge is below the left one. */
  roll: number
}

const RADIAN = Math.PI / 180

/** The tilt of the screen.
 *
 * @param screenAngle `screen.orientation.angle`: clockwise rotation of the page on the phone
 * @returns null when the phone reports no angles
 */
export function poseOf({ beta, gamma }: Orientation, screenAngle: number): Pose | null {
  if (beta === null || gamma === null || !Number.isFinite(beta) || !Number.isFinite(gamma)) return null
  const [b, g, a] = [beta * RADIAN, gamma * RADIAN, screenAngle * RADIAN]
  // The direction of gravity in the frame of the phone (DeviceOrientation, W3C, section 4.1), then of the page.
  const [x, y, z] = [Math.cos(b) * Math.sin(g), -Math.sin(b), -Math.cos(b) * Math.cos(g)]
  const right = x * Math.cos(a) - y * Math.sin(a)
  const up = x * Math.sin(a) + y * Math.cos(a)
  return { pitch: Math.atan2(-up, -z) / RADIAN, roll: Math.asin(Math.max(-1, Math.min(1, right))) / RADIAN }
}

/** Tilt of the phone since the button was pressed. */
export function steering(now: Pose, neutral: Pose): { turn: number; ahead: number } {
  const pitched = ((now.pitch - neutral.pitch + 540) % 360) - 180
  return { turn: share(neutral.roll - now.roll), ahead: share(-pitched) }
}

function share(angle: number): number {
  const beyond = Math.max(0, Math.abs(angle) - DEAD_ANGLE) / (FULL_ANGLE - DEAD_ANGLE)
  return Math.sign(angle) * Math.min(1, beyond) + 0
}

/** The drive that the phone controls. */
export interface Wheel {
  grab(): boolean
  steer(turn: number, ahead: number): void
  release(): void
  silent(): void
}

/** Drives by the tilt of the phone while a button is held. */
export class TiltDriver {
  private latest: { pose: Pose; atMs: number } | null = null
  private neutral: Pose | null = null

  constructor(private readonly wheel: Wheel) {}

  get isHeld(): boolean {
    return this.neutral !== null
  }

  /** The button was pressed: the present tilt is neutral. Returns whether driving has begun. */
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

  /** Driving ended for another reason: the button must be pressed again. */
  requireRelease(): void {
    this.neutral = null
  }

  /** The phone reported its orientation; without angles it is ignored. */
  handleOrientation(event: Orientation, screenAngle: number, nowMs: number): void {
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

/** Why tilt is not available here, or null.
 *
 * @param page the used part of `window`
 */
export function whyNoTilt(page: { isSecureContext: boolean; DeviceOrientationEvent?: unknown }): string | null {
  if (!page.isSecureContext) return 'Browsers report the orientation only over https.'
  return page.DeviceOrientationEvent === undefined ? 'This browser does not report the orientation.' : null
}

/** Requests the permission of the user if the system needs it (iOS). Must be called from a tap. */
export async function askLeave(kind: unknown): Promise<boolean> {
  const ask = (kind as { requestPermission?: () => Promise<string> } | undefined)?.requestPermission
  if (ask === undefined) return true
  try {
    return (await ask.call(kind)) === 'granted'
  } catch {
    return false
  }
}
