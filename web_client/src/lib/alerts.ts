/** What people should know of robots though nobody looks (protocol/SPEC.md 1.10). Times in Unix seconds. */

export type AlertLevel = 'info' | 'warning' | 'error'

export interface Alert {
  id: string
  robot: string
  kind: string
  about: string
  level: AlertLevel
  text: string
  first: number
  last: number
  count: number
  state: 'open' | 'over'
  over: number | null
  acknowledged: { by: string; at: number } | null
  may_acknowledge: boolean
  news: number
  notify: boolean
}

/** What the list shows. */
export interface Filter {
  robot: string
  state: 'all' | 'open' | 'over'
}

/** A part of a list, the latest first.
 *
 * `next`: what asks for the part after it; null where there is none
 */
export interface Page {
  alerts: Alert[]
  next: string | null
}

/** The relay gives no more at a time. */
export const AT_ONCE = 500

/** A list up to a length, however many answers that takes.
 *
 * @param ask gives a part: how many at most, and after what
 */
export async function gather(ask: (limit: number, before: string | null) => Promise<Page>, most: number): Promise<Page> {
  const alerts: Alert[] = []
  let next: string | null = null
  do {
    const page = await ask(Math.min(most - alerts.length, AT_ONCE), next)
    alerts.push(...page.alerts)
    next = page.next
  } while (next !== null && alerts.length < most)
  return { alerts, next }
}

/** How many alerts a page knows that it has told of. */
export const REMEMBERED = 2000

/** Which alerts are news to this page: told of none twice, and of none that stood when it was opened.
 *
 * The stream tells of no more than a hundred, so one that stands may leave it, and come back when others are over.
 */
export class News {
  /** How much of the news of each alert was shown, or need not be; the one that was seen last is the last. */
  private told: Map<string, number> | null = null
  /** Unix seconds when the newest of all began; of what began before, some may have been left out of a full list. */
  private newest = -Infinity
  private wasFull = false

  /** Takes the list as it is now, and tells what the user should be told of, the oldest first. */
  take(alerts: readonly Alert[]): Alert[] {
    const before = this.told
    const fresh = before === null ? [] : alerts.filter((alert) => alert.notify && alert.news > this.known(alert)).reverse()
    const told = new Map(before)
    for (const alert of [...alerts].reverse()) {
      const { id } = alert
      told.delete(id)
      told.set(id, settled(alert, before === null ? null : this.known(alert)))
    }
    for (const id of [...told.keys()].slice(0, Math.max(0, told.size - REMEMBERED))) told.delete(id)
    this.told = told
    this.newest = alerts.reduce((newest, { first }) => Math.max(newest, first), this.newest)
    this.wasFull = alerts.length >= STREAMED
    return fresh
  }

  /** Up to where the news of an alert need not be told. */
  private known({ id, first, news }: Alert): number {
    return this.told?.get(id) ?? (this.wasFull && first <= this.newest ? news : 0)
  }
}

/** What is not wanted now is wanted at the end of quiet hours, unless it was over before anybody was told of it. */
function settled({ news, notify, state }: Alert, known: number | null): number {
  const toCome = known !== null && !notify && (state === 'open' || known > 0)
  return toCome ? known : Math.max(news, known ?? 0)
}

/** How many a person has to look at: they stand, and nobody said that he looks after them. */
export function waiting(alerts: readonly Alert[]): number {
  return alerts.filter(({ state, acknowledged }) => state === 'open' && acknowledged === null).length
}

/** An alert in a line. */
export function line({ robot, text, state }: Pick<Alert, 'robot' | 'text' | 'state'>): string {
  return state === 'over' ? `${robot}: over: ${text}` : `${robot}: ${text}`
}

/** The one of several, the oldest first, that is told in its own words: the latest of the worst that stand. */
export function leading(alerts: readonly Alert[]): Alert {
  const level = worst(standing(alerts))
  return alerts.findLast((alert) => alert.state === 'open' && alert.level === level) ?? alerts.at(-1)!
}

/** Several alerts in a line, the oldest first. */
export function summary(alerts: readonly Alert[]): string {
  const words = line(leading(alerts))
  return alerts.length === 1 ? words : `${words}, and ${alerts.length - 1} more`
}

/** Those that are open. */
export function standing(alerts: readonly Alert[]): Alert[] {
  return alerts.filter(({ state }) => state === 'open')
}

const LEVELS: readonly AlertLevel[] = ['info', 'warning', 'error']

/** The worst level there is; null without alerts. */
export function worst(alerts: readonly Pick<Alert, 'level'>[]): AlertLevel | null {
  return LEVELS.findLast((level) => alerts.some((alert) => alert.level === level)) ?? null
}

/** Whether a level is worse than another; any is worse than none. */
export function isWorse(level: AlertLevel | null, than: AlertLevel | null): boolean {
  const rank = (each: AlertLevel | null) => (each === null ? -1 : LEVELS.indexOf(each))
  return rank(level) > rank(than)
}

/** A list that was asked for, with what was told since put in; the latest first. */
export function merged(list: readonly Alert[], live: readonly Alert[], filter: Filter): Alert[] {
  const all = new Map(list.map((alert) => [alert.id, alert]))
  for (const alert of live) all.set(alert.id, alert)
  return [...all.values()].filter((alert) => fits(alert, filter)).sort((a, b) => b.last - a.last)
}

/** The stream tells of no more. */
export const STREAMED = 100

/** Whether an alert has left the stream while it stood: it ended unheard, or is the user's no more. */
export function leftOpen(before: readonly Alert[], now: readonly Alert[]): boolean {
  // A full list leaves out what is older.
  if (now.length >= STREAMED) return false
  const there = new Set(now.map(({ id }) => id))
  return before.some(({ id, state }) => state === 'open' && !there.has(id))
}

function fits(alert: Alert, { robot, state }: Filter): boolean {
  return (robot === '' || alert.robot === robot) && (state === 'all' || alert.state === state)
}
