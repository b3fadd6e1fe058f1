/** Rates and staleness of what arrives, by the clock of the page (milliseconds). */

export const STALE_MS = 1000

/** Counts events in a sliding window. */
export class RateMeter {
  private times: number[] = []
  private sinceMs: number | null = null

  constructor(private readonly windowMs = 2000) {}

  mark(nowMs: number): void {
    this.sinceMs ??= nowMs
    this.times.push(nowMs)
    this.trim(nowMs)
  }

  /** Events per second over the window, 0 when nothing came. */
  hz(nowMs: number): number {
    this.trim(nowMs)
    if (this.sinceMs === null) return 0
    const span = nowMs - this.sinceMs
    if (span >= this.windowMs) return (this.times.length * 1000) / this.windowMs
    // Before the window is full the first mark opens it and is not counted.
    return this.times.length < 2 ? 0 : ((this.times.length - 1) * 1000) / Math.max(span, 1)
  }

  reset(): void {
    this.times = []
    this.sinceMs = null
  }

  private trim(nowMs: number): void {
    while (this.times.length > 0 && this.times[0]! <= nowMs - this.windowMs) this.times.shift()
  }
}

/** Whether a value that arrived at a time is too old to be shown as current; null means nothing came yet. */
export function isStale(lastMs: number | null, nowMs: number, limitMs = STALE_MS): boolean {
  return lastMs === null || nowMs - lastMs > limitMs
}

/** Lets through at most one call per interval. */
export class Gate {
  private lastMs = -Infinity

  constructor(private readonly intervalMs: number) {}

  open(nowMs: number): boolean {
    if (nowMs - this.lastMs < this.intervalMs) return false
    this.lastMs = nowMs
    return true
  }
}
