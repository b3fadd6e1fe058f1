/** Who moves the robot, as the relay tells it (protocol/SPEC.md 1.7, Control). Times in Unix seconds. */
import type { Limits } from './drive'
import { people } from './format'
import type { Level } from './types'

interface Person {
  user: string
  /** The number of the connection. */
  client: number
  since: number
  /** Whether it is this page's connection. */
  you: boolean
}

export interface Holder extends Person {
  /** Whether a command took it, of a program that answers nobody. */
  implicit: boolean
}

export interface Request extends Person {
  why: string
  /** From then on an owner, or of an implicit holder anybody, takes over by asking again. */
  until: number
}

export interface Stop {
  by: string
  why: string
  since: number
}

export interface Stopped extends Stop {
  /** Whether the robot has confirmed it. */
  told: boolean
  /** The latest of those who have stopped it since. */
  again?: Stop | null
}

/** What a press to let robots move again is about: it is another one when somebody stops any of them meanwhile. */
export function stops(all: (Stopped | null | undefined)[]): string {
  return JSON.stringify(all.map((stopped) => stopped && [stopped.since, stopped.by, stopped.again?.since, stopped.again?.by]))
}

/** A topic that others command than who has control. */
export interface Suppressed {
  resource: string
  /** Numbers of the connections that do. */
  sources: number[]
  by: string
}

/** A topic that says nothing, or with `hold` its last value again and again. */
export interface Inhibited {
  resource: string
  hold: boolean
  by: string
}

export interface LevelLimits {
  linear?: number | null
  angular?: number | null
}

export interface Control {
  robot: string
  state: 'free' | 'held' | 'requested'
  holder: Holder | null
  request: Request | null
  stopped: Stopped | null
  moving: boolean
  suppressed: Suppressed[]
  inhibited: Inhibited[]
  limits: Partial<Record<Level, LevelLimits>>
  you: { client: number | null; may_control: boolean; may_resume: boolean }
}

/** How this page stands to control.
 *
 * `asked`: it holds it and somebody wants it. `elsewhere`: another window of the user holds it. `waiting`: it has
 * asked. `ripe`: it has asked, there was no answer, and it may take over.
 */
export type Standing = 'unknown' | 'free' | 'yours' | 'asked' | 'held' | 'elsewhere' | 'waiting' | 'ripe'

export function standing(control: Control | null, me: string, level: Level | null, now: number): Standing {
  if (control === null) return 'unknown'
  const { holder, request } = control
  if (holder === null) return 'free'
  if (holder.you) return request === null ? 'yours' : 'asked'
  const comesDue = level === 'owner' || holder.implicit
  if (request?.you) return comesDue && now >= request.until ? 'ripe' : 'waiting'
  return holder.user === me ? 'elsewhere' : 'held'
}

export function isYours(control: Control | null): boolean {
  return control?.holder?.you === true
}

/** Whole seconds the holder has left to answer. */
export function secondsLeft(request: Request, now: number): number {
  return Math.max(0, Math.ceil(request.until - now))
}

/** Who has control, in a sentence. */
export function sentenceOf(control: Control | null, stands: Standing, now: number): string {
  if (control === null) return 'Waiting to hear who has control.'
  const holder = control.holder?.user ?? ''
  const other = control.request
  switch (stands) {
    case 'free':
      return 'Nobody has control.'
    case 'yours':
      return 'You have control.'
    case 'asked':
      return `You have control. ${other?.user ?? 'Somebody'} asks for it.`
    case 'elsewhere':
      return 'You have control in another window.'
    case 'ripe':
      return `${holder} has not answered. You may take over.`
    case 'waiting':
      return other !== null && now < other.until
        ? `You have asked ${holder} for control.`
        : `${holder} has not answered yet.`
    default:
      return other === null ? `${holder} has control.` : `${holder} has control, ${other.user} asks for it.`
  }
}

/** What the driver is told who had control and has it no more. */
export function whyLost(after: Control, offline: boolean): string {
  if (offline) return 'Control went with the robot’s link. Take it anew when the robot is back.'
  if (after.holder === null) return 'You no longer have control. It is free: take it to drive on.'
  return `${after.holder.user} has control now.`
}

/** Who commands a topic in the place of who has control, when that is not this page; null for nobody. */
export function suppressor(control: Control | null, topic: string | null): string | null {
  const found = control?.suppressed.find(({ resource }) => resource === topic)
  const own = control?.you.client ?? null
  return found === undefined || (own !== null && found.sources.includes(own)) ? null : found.by
}

/** That a topic does not say how things are now, in words; null when it does. */
export function silenced(control: Control | null, topic: string | null): string | null {
  const found = control?.inhibited.find(({ resource }) => resource === topic)
  if (found === undefined) return null
  return `${found.hold ? 'held' : 'inhibited'} by ${found.by || 'somebody'}`
}

/** Who may let a stopped robot move again, for those who may not. */
export function whoMayResume(control: Control): string {
  const holder = control.holder?.user
  return holder === undefined ? 'An owner of the robot can resume it.' : `${holder}, who has control, or an owner can resume it.`
}

/** The robot's own limits for a level; null where it has none. */
export function topOf(control: Control | null, level: Level | null): { linear: number | null; angular: number | null } {
  const limits = level === null ? undefined : control?.limits[level]
  const positive = (value: number | null | undefined) =>
    typeof value === 'number' && Number.isFinite(value) && value >= 0 ? value : null
  return { linear: positive(limits?.linear), angular: positive(limits?.angular) }
}

/** What was chosen, within what the robot allows. */
export function within(chosen: Limits, top: ReturnType<typeof topOf>): Limits {
  return {
    linear: Math.min(chosen.linear, top.linear ?? Infinity),
    angular: Math.min(chosen.angular, top.angular ?? Infinity),
  }
}

/** The first way that does it; when none does, the error that says most.
 *
 * @throws Error of the way that was refused in words, else of the first
 */
export async function byAnyWay<T>(ways: Promise<T>[], says: (error: unknown) => boolean): Promise<T> {
  try {
    return await Promise.any(ways)
  } catch (error) {
    const errors = error instanceof AggregateError ? error.errors : [error]
    throw errors.find(says) ?? errors[0]
  }
}

/** Names for the badge in the top bar: who moves the robot now. */
export function holderBadge(control: Control | null): string | null {
  if (control?.holder == null) return null
  return control.holder.you ? 'You have control' : `${people([control.holder.user])} has control`
}
