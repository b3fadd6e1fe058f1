/** Alerts of robots (SPEC 1.10). Times in Unix seconds. */
import type { Alert, AlertLevel, AlertPage } from './types'

/** Filter of the list. */
export interface Filter {
  robot: string
  state: 'all' | 'open' | 'over'
}

/** Most items of one answer of the relay. */
export const AT_ONCE = 500

/** A list up to a length, from as many answers as needed.
 *
 * @param ask requests a part: the most items, and the cursor
 */
export async function fetchAllPages(ask: (limit: number, before: string | null) => Promise<AlertPage>, most: number): Promise<AlertPage> {
  const alerts: Alert[] = []
  let next: string | null = null
  do {
    const page = await ask(Math.min(most - alerts.length, AT_ONCE), next)
    alerts.push(...page.alerts)
    next = page.next
  } while (next !== null && alerts.length < most)
  return { alerts, next }
}

/** Most alerts that a page remembers as shown. */
export const REMEMBERED = 2000

/** Finds the alerts that are new to this page: none twice, and none that was open when the page was opened.
 *
 * The stream has at most a hundred alerts, so an open one may leave it, and return when others are over.
 */
export class News {
  /** For each alert the state that was shown, or need not be shown; the one updated last is the last. */
  private announced: Map<string, number> | null = null
  /** Unix seconds at which the newest alert began; older ones may be missing in a full list. */
  private newest = -Infinity
  private wasFull = false

  /** Takes the present list; returns the alerts to be shown, the oldest first. */
  take(alerts: readonly Alert[]): Alert[] {
    const before = this.announced
    const fresh = before === null ? [] : alerts.filter((alert) => alert.notify && alert.notification_count > this.known(alert)).reverse()
    const announced = new Map(before)
    for (const alert of [...alerts].reverse()) {
      const { id } = alert
      announced.delete(id)
      announced.set(id, settled(alert, before === null ? null : this.known(alert)))
    }
    for (const id of [...announced.keys()].slice(0, Math.max(0, announced.size - REMEMBERED))) announced.delete(id)
    this.announced = announced
    this.newest = alerts.reduce((newest, { first }) => Math.max(newest, first), this.newest)
    this.wasFull = alerts.length >= STREAMED
    return fresh
  }

  /** The state of an alert up to which nothing need be shown. */
  private known({ id, first, notification_count: count }: Alert): number {
    return this.announced?.get(id) ?? (this.wasFull && first <= this.newest ? count : 0)
  }
}

/** An alert in quiet hours is shown at their end, unless it is over by then. */
function settled({ notification_count: count, notify, state }: Alert, known: number | null): number {
  const toCome = known !== null && !notify && (state === 'open' || known > 0)
  return toCome ? known : Math.max(count, known ?? 0)
}

/** Number of open alerts that are not acknowledged. */
export function waiting(alerts: readonly Alert[]): number {
  return alerts.filter(({ state, acknowledged }) => state === 'open' && acknowledged === null).length
}

/** An alert as one line. */
export function line({ robot, text, state }: Pick<Alert, 'robot' | 'text' | 'state'>): string {
  return state === 'over' ? `${robot}: over: ${text}` : `${robot}: ${text}`
}

/** The alert of several, the oldest first, that represents them: the latest of the worst open ones. */
export function leading(alerts: readonly Alert[]): Alert {
  const level = worst(standing(alerts))
  return alerts.findLast((alert) => alert.state === 'open' && alert.level === level) ?? alerts.at(-1)!
}

/** Several alerts as one line. The oldest is the first. */
export function summary(alerts: readonly Alert[]): string {
  const words = line(leading(alerts))
  return alerts.length === 1 ? words : `${words}, and ${alerts.length - 1} more`
}

/** The open alerts. */
export function standing(alerts: readonly Alert[]): Alert[] {
  return alerts.filter(({ state }) => state === 'open')
}

const LEVELS: readonly AlertLevel[] = ['info', 'warning', 'error']

/** The worst level; null without alerts. */
export function worst(alerts: readonly Pick<Alert, 'level'>[]): AlertLevel | null {
  return LEVELS.findLast((level) => alerts.some((alert) => alert.level === level)) ?? null
}

/** Whether a level is worse than another; any is worse than none. */
export function isWorse(level: AlertLevel | null, than: AlertLevel | null): boolean {
  const rank = (each: AlertLevel | null) => (each === null ? -1 : LEVELS.indexOf(each))
  return rank(level) > rank(than)
}

/** A loaded list with later updates merged in; the latest first. */
export function merged(list: readonly Alert[], live: readonly Alert[], filter: Filter): Alert[] {
  const all = new Map(list.map((alert) => [alert.id, alert]))
  for (const alert of live) all.set(alert.id, alert)
  return [...all.values()].filter((alert) => fits(alert, filter)).sort((a, b) => b.last - a.last)
}

/** Most alerts in the stream. */
export const STREAMED = 100

/** Whether an open alert has left the stream: it has ended without an update, or the user lost the right to it. */
export function leftOpen(before: readonly Alert[], now: readonly Alert[]): boolean {
  // A full list omits older alerts.
  if (now.length >= STREAMED) return false
  const there = new Set(now.map(({ id }) => id))
  return before.some(({ id, state }) => state === 'open' && !there.has(id))
}

function fits(alert: Alert, { robot, state }: Filter): boolean {
  return (robot === '' || alert.robot === robot) && (state === 'all' || alert.state === state)
}
