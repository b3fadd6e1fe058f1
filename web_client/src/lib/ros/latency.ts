/** Round trips to the relay and to the robot, and whether the link is late. Times in milliseconds. */

export const PONG_TIMEOUT_MS = 500

/** Time without an answer after which a robot counts as late. Its watchdog has stopped it long before. */
export const ROBOT_LATE_MS = 1000

/** Intervals of pings while driving and otherwise. */
export const PING_DRIVING_MS = 200
export const PING_IDLE_MS = 1000

const FORGET_MS = 30_000

export interface RoundTrips {
  clientRelay: number | null
  relayRobot: number | null
  clientRobot: number | null
}

/** The median of the last few values, so that one outlier does not change it. */
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

/** Unanswered pings, and the round trips of the last answered ones. */
export class PingTracker {
  private out = new Map<number, number>()
  private next = 1
  private trips = new Median()

  /** A ping is sent; returns its number. */
  sent(nowMs: number): number {
    const number = this.next++
    this.out.set(number, nowMs)
    for (const [other, atMs] of this.out) if (nowMs - atMs > FORGET_MS) this.out.delete(other)
    return number
  }

  /** A ping was answered; returns the round trip, or null if it had expired. */
  answered(number: number, nowMs: number): number | null {
    const atMs = this.out.get(number)
    if (atMs === undefined) return null
    // Answers keep their order, so earlier unanswered pings will never be answered.
    for (const other of this.out.keys()) if (other <= number) this.out.delete(other)
    const rtt = nowMs - atMs
    this.trips.add(rtt)
    return rtt
  }

  /** A ping failed for a reason that says nothing about the link. */
  dropped(number: number): void {
    this.out.delete(number)
  }

  /** Whether a ping has been unanswered for longer than the timeout. */
  isLate(nowMs: number): boolean {
    return this.silentFor(nowMs) > PONG_TIMEOUT_MS
  }

  /** Age of the oldest unanswered ping, 0 if there is none. */
  silentFor(nowMs: number): number {
    let longest = 0
    for (const atMs of this.out.values()) longest = Math.max(longest, nowMs - atMs)
    return longest
  }

  /** Median of recent round trips, or null before the first answer. */
  get rtt(): number | null {
    return this.trips.value
  }

  reset(): void {
    this.out.clear()
    this.trips.reset()
  }
}

/** Time since the robot has answered a ping. A ping that fails does not change it. */
export class Silence {
  private sinceMs: number | null = null

  sent(nowMs: number): void {
    this.sinceMs ??= nowMs
  }

  /** The ping was answered, or has expired. */
  over(): void {
    this.sinceMs = null
  }

  isLate(nowMs: number): boolean {
    return this.sinceMs !== null && nowMs - this.sinceMs > ROBOT_LATE_MS
  }
}

/** Estimates the relay's clock, by the quickest of the latest exchanges. */
export class RelayClock {
  private exchanges: { tripMs: number; aheadMs: number }[] = []

  /** Takes the relay’s time.
   *
   * @param relayMs Unix time in milliseconds, read between the two moments of the page
   */
  update(sentMs: number, nowMs: number, relayMs: number): void {
    const exchange = { tripMs: nowMs - sentMs, aheadMs: relayMs - (sentMs + nowMs) / 2 }
    this.exchanges = [...this.exchanges, exchange].slice(-16)
  }

  /** Unix time by the relay's clock, in milliseconds; null before the first. */
  unixMs(nowMs: number): number | null {
    const [surest] = [...this.exchanges].sort((a, b) => a.tripMs - b.tripMs)
    return surest === undefined ? null : nowMs + surest.aheadMs
  }

  reset(): void {
    this.exchanges = []
  }
}

export type Grade = 'good' | 'fair' | 'bad'

/** Quality of a round trip for driving, with the thresholds of the relay (SPEC 1.7). */
export function grade(rttMs: number): Grade {
  if (rttMs < 100) return 'good'
  return rttMs < 300 ? 'fair' : 'bad'
}
