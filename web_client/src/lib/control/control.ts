/** State of control of a robot (SPEC 1.7, Control). Times in Unix seconds. */
import type { Limits } from './drive'
import { people } from '../format'
import type { Control, ControlRequest, Level, Stopped } from '../api/types'

/** A new id for one press of a stop button. The relay counts stops with the same id as one, by whatever paths they come. */
export function newStopId(): string {
  // Pages over plain HTTP have no randomUUID.
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, '0')).join('')
}

/** Identity of a resume press; it changes when any of the robots is stopped meanwhile. */
export function stops(all: (Stopped | null | undefined)[]): string {
  return JSON.stringify(all.map((stopped) => stopped && [stopped.since, stopped.by, stopped.again?.since, stopped.again?.by]))
}

/** Relation of this page to control.
 *
 * `asked`: this page has control, and another client requests it. `elsewhere`: another window of the user has it.
 * `waiting`: this page has requested it. `may_take_over`: the request was not answered, so this page may take over.
 */
export type ControlState = 'unknown' | 'free' | 'yours' | 'asked' | 'held' | 'elsewhere' | 'waiting' | 'may_take_over'

export function controlState(control: Control | null, me: string, level: Level | null, now: number): ControlState {
  if (control === null) return 'unknown'
  const { holder, request } = control
  if (holder === null) return 'free'
  if (holder.you) return request === null ? 'yours' : 'asked'
  const comesDue = level === 'owner' || holder.implicit
  if (request?.you) return comesDue && now >= request.until ? 'may_take_over' : 'waiting'
  return holder.user === me ? 'elsewhere' : 'held'
}

export function isYours(control: Control | null): boolean {
  return control?.holder?.you === true
}

/** Whole seconds the holder has left to answer. */
export function secondsLeft(request: ControlRequest, now: number): number {
  return Math.max(0, Math.ceil(request.until - now))
}

/** The holder of control, in a sentence. */
export function sentenceOf(control: Control | null, state: ControlState, now: number): string {
  if (control === null) return 'Waiting for the state of control.'
  const holder = control.holder?.user ?? ''
  const other = control.request
  switch (state) {
    case 'free':
      return 'Nobody has control.'
    case 'yours':
      return 'You have control.'
    case 'asked':
      return `You have control. ${other?.user ?? 'Another user'} requests it.`
    case 'elsewhere':
      return 'You have control in another window.'
    case 'may_take_over':
      return `${holder} has not answered. You may take over.`
    case 'waiting':
      return other !== null && now < other.until
        ? `You have requested control from ${holder}.`
        : `${holder} has not answered yet.`
    default:
      return other === null ? `${holder} has control.` : `${holder} has control, ${other.user} requests it.`
  }
}

/** Message for a user who has lost control. */
export function whyLost(after: Control, offline: boolean): string {
  if (offline) return 'Control was lost with the robot’s link. Take it again when the robot is online.'
  if (after.holder === null) return 'You no longer have control. It is free: take control to continue driving.'
  return `${after.holder.user} has control now.`
}

/** The user that suppresses a topic from another connection; null for none. */
export function suppressor(control: Control | null, topic: string | null): string | null {
  const found = control?.suppressed.find(({ resource }) => resource === topic)
  const own = control?.you.client ?? null
  return found === undefined || (own !== null && found.sources.includes(own)) ? null : found.by
}

/** Why the messages of a topic do not show the present state; null if they do. */
export function suppressionText(control: Control | null, topic: string | null): string | null {
  const found = control?.inhibited.find(({ resource }) => resource === topic)
  if (found === undefined) return null
  return `${found.hold ? 'held' : 'inhibited'} by ${found.by || 'another client'}`
}

/** Hint for users who may not resume the robot. */
export function resumeHint(control: Control): string {
  const holder = control.holder?.user
  return holder === undefined ? 'An owner of the robot can resume it.' : `${holder}, who has control, or an owner can resume it.`
}

/** The robot's own limits for a level; null if it has none. */
export function topOf(control: Control | null, level: Level | null): { linear: number | null; angular: number | null } {
  const limits = level === null ? undefined : control?.limits[level]
  const positive = (value: number | null | undefined) =>
    typeof value === 'number' && Number.isFinite(value) && value >= 0 ? value : null
  return { linear: positive(limits?.linear), angular: positive(limits?.angular) }
}

/** The chosen limits, bounded by those of the robot. */
export function within(chosen: Limits, top: ReturnType<typeof topOf>): Limits {
  return {
    linear: Math.min(chosen.linear, top.linear ?? Infinity),
    angular: Math.min(chosen.angular, top.angular ?? Infinity),
  }
}

/** Result of the first request that succeeds; if none does, the most informative error.
 *
 * @throws the error that was refused with a reason, else the first
 */
export async function firstSuccess<T>(ways: Promise<T>[], says: (error: unknown) => boolean): Promise<T> {
  try {
    return await Promise.any(ways)
  } catch (error) {
    const errors = error instanceof AggregateError ? error.errors : [error]
    throw errors.find(says) ?? errors[0]
  }
}

/** Text of the badge in the top bar: the holder of control. */
export function holderBadge(control: Control | null): string | null {
  if (control?.holder == null) return null
  return control.holder.you ? 'You have control' : `${people([control.holder.user])} has control`
}
