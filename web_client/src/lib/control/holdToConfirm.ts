/** A button that must be held to confirm its action. Times in milliseconds. */

export const HOLD_MS = 1500

export class Hold {
  private since: number | null = null

  constructor(private readonly holdMs = HOLD_MS) {}

  press(nowMs: number): void {
    this.since ??= nowMs
  }

  lift(): void {
    this.since = null
  }

  /** Progress, 0 to 1. */
  share(nowMs: number): number {
    return this.since === null ? 0 : Math.max(0, Math.min(1, (nowMs - this.since) / this.holdMs))
  }

  /** Whether it was held long enough. True once; then it must be pressed again. */
  isDone(nowMs: number): boolean {
    if (this.share(nowMs) < 1) return false
    this.since = null
    return true
  }
}
