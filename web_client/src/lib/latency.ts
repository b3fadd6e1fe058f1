/** Round trips to the relay and to the robot, and whether the link is late. Times in milliseconds. */

export const PONG_TIMEOUT_MS = 500

/** A robot from which no answer came for so long may no longer be there; its watchdog has long stopped it. */
export const ROBOT_LATE_MS = 1000

/** How often to ping while driving and otherwise. */
export const PING_DRIVING_MS = 200
export const PING_IDLE_MS = 1000

const FORGET_MS = 30_000

export interface Legs {
  clientRelay: number | null
  relayRobot: number | null
  clientRobot: number | null
}

/** The median of the last few values: one outlier does not move it, and it holds no old ones for long. */
export class Median {
  private values: number[] = []

  constructor(private readonly size = 5) {}

  add(value: number): number {
    this.values = [...this.values, value].slice(-this.size)
    return this.value!
  }

  get value(): number | null {
    const sorted = [...this.values].sort((a, b) => a - b)
    return sorted[Math.floor(sorted.length / 2)] ?? null
  }

  reset(): void {
    this.values = []
  }
}

/** Remembers pings that are out and how long the last ones took. */
export class PingTracker {
  private out = new Map<number, number>()
  private next = 1
  private trips = new Median()

  /** A ping leaves; the number names it. */
  sent(nowMs: number): number {
    const number = this.next++
    this.out.set(number, nowMs)
    for (const [other, atMs] of this.out) if (nowMs - atMs > FORGET_MS) this.out.delete(other)
    return number
  }

  /** Its answer came; returns the round trip, or null when it was given up before. */
  answered(number: number, nowMs: number): number | null {
    const atMs = this.out.get(number)
    if (atMs === undefined) return null
    // Answers keep their order, so what left earlier and is still out won't be answered any more.
    for (const other of this.out.keys()) if (other <= number) this.out.delete(other)
    const rtt = nowMs - atMs
    this.trips.add(rtt)
    return rtt
  }

  /** A ping failed for another reason than time, it says nothing about the link. */
  dropped(number: number): void {
    this.out.delete(number)
  }

  /** Whether a ping has been out for longer than the pong timeout. */
  isLate(nowMs: number): boolean {
    return this.silentFor(nowMs) > PONG_TIMEOUT_MS
  }

  /** How long the oldest unanswered ping has been out, 0 when none is. */
  silentFor(nowMs: number): number {
    let longest = 0
    for (const atMs of this.out.values()) longest = Math.max(longest, nowMs - atMs)
    return longest
  }

  /** The usual round trip of late, or null before the first answer. */
  get rtt(): number | null {
    return this.trips.value
  }

  reset(): void {
    this.out.clear()
    this.trips.reset()
  }
}

/** How long the robot has left the pings to it unanswered; a ping that fails leaves it as silent as it was. */
export class Silence {
  private sinceMs: number | null = null

  sent(nowMs: number): void {
    this.sinceMs ??= nowMs
  }

  /** It answered, or nobody waits for it any more. */
  over(): void {
    this.sinceMs = null
  }

  isLate(nowMs: number): boolean {
    return this.sinceMs !== null && nowMs - this.sinceMs > ROBOT_LATE_MS
  }
}

/** The relay's clock as seen from the page; of the latest exchanges the quickest is the surest. */
export class RelayClock {
  private exchanges: { tripMs: number; aheadMs: number }[] = []

  /** The relay told its time.
   *
   * @param relayMs Unix time in milliseconds, read between the two moments of the page
   */
  told(sentMs: number, nowMs: number, relayMs: number): void {
    const exchange = { tripMs: nowMs - sentMs, aheadMs: relayMs - (sentMs + nowMs) / 2 }
    this.exchanges = [...this.exchanges, exchange].slice(-16)
  }

  /** Unix time by the relay's clock, in milliseconds; null before it told any. */
  unixMs(nowMs: number): number | null {
    const [surest] = [...this.exchanges].sort((a, b) => a.tripMs - b.tripMs)
    return surest === undefined ? null : nowMs + surest.aheadMs
  }

  reset(): void {
    this.exchanges = []
  }
}

export type Grade = 'good' | 'fair' | 'bad'

/** How a round trip feels for driving; the relay's words for links (protocol/SPEC.md 1.7) change at the same figures. */
export function grade(rttMs: number): Grade {
  if (rttMs < 100) return 'good'
  return rttMs < 300 ? 'fair' : 'bad'
}
