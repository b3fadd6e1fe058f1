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

/** Which alerts are news to this page: told of none twice, and of none that stood when it was opened. */
export class News {
  /** How much of the news of each alert was shown, or need not be. */
  private told: Map<string, number> | null = null

  /** Takes the list as it is now, and tells what the user should be told of, the oldest first. */
  take(alerts: readonly Alert[]): Alert[] {
    const before = this.told
    this.told = new Map(alerts.map((alert) => [alert.id, settled(alert, before)]))
    if (before === null) return []
    return alerts.filter(({ id, news, notify }) => notify && news > (before.get(id) ?? 0)).reverse()
  }
}

/** What is not wanted now is wanted at the end of quiet hours, unless it was over before anybody was told of it. */
function settled({ id, news, notify, state }: Alert, before: ReadonlyMap<string, number> | null): number {
  const known = before?.get(id) ?? 0
  const toCome = before !== null && !notify && (state === 'open' || known > 0)
  return toCome ? known : Math.max(news, known)
}

/** How many a person has to look at: they stand, and nobody said that he looks after them. */
export function waiting(alerts: readonly Alert[]): number {
  return alerts.filter(({ state, acknowledged }) => state === 'open' && acknowledged === null).length
}

/** An alert in a line. */
export function line({ robot, text, state }: Pick<Alert, 'robot' | 'text' | 'state'>): string {
  return state === 'over' ? `${robot}: over: ${text}` : `${robot}: ${text}`
}

/** Whether so few are new that each is told in its own words. */
export function isFew(alerts: readonly Alert[]): boolean {
  return alerts.length <= 2
}

/** Several alerts in lines: each of a few, else how many. */
export function lines(alerts: readonly Alert[]): string[] {
  if (isFew(alerts)) return alerts.map(line)
  const robots = new Set(alerts.map(({ robot }) => robot)).size
  return [`${alerts.length} new alerts of ${robots === 1 ? alerts[0]!.robot : `${robots} robots`}.`]
}

/** The worst level there is; null without alerts. */
export function worst(alerts: readonly Pick<Alert, 'level'>[]): AlertLevel | null {
  const levels: AlertLevel[] = ['error', 'warning', 'info']
  return levels.find((level) => alerts.some((alert) => alert.level === level)) ?? null
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
