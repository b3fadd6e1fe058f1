/** Rate and age of received messages, by the clock of the page (milliseconds). */

export const STALE_MS = 1000

/** Counts events, or adds up their values, in a sliding window. */
export class RateMeter {
  private marks: { atMs: number; amount: number }[] = []
  private sinceMs: number | null = null

  constructor(private readonly windowMs = 2000) {}

  mark(nowMs: number, amount = 1): void {
    this.sinceMs ??= nowMs
    this.marks.push({ atMs: nowMs, amount })
    this.trim(nowMs)
  }

  /** Rate per second over the window, 0 without events. */
  perSecond(nowMs: number): number {
    this.trim(nowMs)
    if (this.sinceMs === null) return 0
    const span = nowMs - this.sinceMs
    // Before the window is full the first mark opens it and is not counted.
    const counted = span >= this.windowMs ? this.marks : this.marks.slice(1)
    const sum = counted.reduce((all, mark) => all + mark.amount, 0)
    return (sum * 1000) / Math.max(Math.min(span, this.windowMs), 1)
  }

  reset(): void {
    this.marks = []
    this.sinceMs = null
  }

  private trim(nowMs: number): void {
    while (this.marks.length > 0 && this.marks[0]!.atMs <= nowMs - this.windowMs) this.marks.shift()
  }
}

/** Whether a value is too old to be shown as current; null as its time means that there is none yet. */
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
