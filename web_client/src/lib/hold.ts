/** A button that has to be held: what it does happens by intent, never by a slip. Times in milliseconds. */

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

  /** How far it is, 0 to 1. */
  share(nowMs: number): number {
    return this.since === null ? 0 : Math.max(0, Math.min(1, (nowMs - this.since) / this.holdMs))
  }

  /** Whether it has been held for long enough; true once, then it has to be pressed anew. */
  isDone(nowMs: number): boolean {
    if (this.share(nowMs) < 1) return false
    this.since = null
    return true
  }
}
