/** Orders to many robots, and the lines of their answers (SPEC 1.11). */
import { people, sentence } from '../format'
import type { Order, OrderKind, OrderLine, OrderResult } from './types'

export interface Progress {
  /** Robots of the order; null before the relay has sent them. */
  meant: string[] | null
  /** Names and patterns that match no robot. */
  unmatched: string[]
  /** Why robots of the order may be missing, in the relay's words; empty if none are. */
  missed: string
  results: OrderResult[]
  /** Whether the answer is complete. */
  done: boolean
}

export const NOTHING_YET: Progress = { meant: null, unmatched: [], missed: '', results: [], done: false }

/** Joins the pieces of an answer to lines. */
export class Lines {
  private rest = ''

  /** The lines that a piece completes. Lines that are not objects are ignored. */
  take(text: string): OrderLine[] {
    const parts = (this.rest + text).split('\n')
    this.rest = parts.pop() ?? ''
    return parts.flatMap((part) => parsed(part))
  }
}

function parsed(text: string): OrderLine[] {
  if (text.trim() === '') return []
  try {
    const value: unknown = JSON.parse(text)
    return typeof value === 'object' && value !== null && !Array.isArray(value) ? [value as OrderLine] : []
  } catch {
    return []
  }
}

/** The state after another line. */
export function after(progress: Progress, line: OrderLine): Progress {
  if ('done' in line) return { ...progress, done: true }
  if ('robot' in line) return { ...progress, results: [...progress.results, line] }
  // A newer relay may send lines that this page does not know.
  if (!('robots' in line)) return progress
  return { ...progress, meant: line.robots, unmatched: line.unmatched, missed: line.missed ?? '' }
}

/** Sentence about names and patterns that match no robot; empty when all match. */
export function unmatchedWords({ unmatched }: Progress): string {
  return unmatched.length === 0 ? '' : `None of your robots matches ${people(unmatched, 5)}.`
}

/** Why robots may be missing in an order; empty if none are. */
export function missedWords({ missed }: Progress): string {
  return missed === '' ? '' : `Other robots of yours may be missing in this order. ${sentence(missed)}`
}

/** Result of each robot, null while it is pending. */
export function table({ meant, results }: Progress): { robot: string; result: OrderResult | null }[] {
  const found = new Map(results.map((result) => [result.robot, result]))
  const names = meant ?? [...found.keys()]
  return names.map((robot) => ({ robot, result: found.get(robot) ?? null }))
}

/** Names, patterns and groups, separated by commas or spaces. */
export function targets(text: string): string[] {
  return Array.from(new Set(text.split(/[\s,]+/).filter(Boolean)))
}

export interface Form {
  do: OrderKind
  /** Name of the service, topic, parameter or module. */
  name: string
  /** What is done with a module. */
  action: 'start' | 'stop' | 'restart'
  type: string
  /** JSON. */
  body: string
  why: string
}

/** The limits of the relay (SPEC 1.11). */
const TARGETS = 1000
const PATTERNS = 64

function isName(target: string): boolean {
  return !target.startsWith('group:') && !/[*?[]/.test(target)
}

/** The field of an order's subject, and that of its body, by kind (SPEC 1.11). */
const SUBJECTS = { call: 'service', publish: 'topic', set: 'name' } as const
const BODIES = { call: 'args', publish: 'msg', set: 'value' } as const

/** The fields of the form that belong to each kind of order. Only these are shown and sent. */
export const FIELDS: Record<OrderKind, readonly (keyof Omit<Form, 'do'>)[]> = {
  stop: ['why'],
  resume: ['why'],
  call: ['name', 'type', 'body', 'why'],
  publish: ['name', 'type', 'body'],
  set: ['name', 'body'],
  module: ['name', 'action'],
}

/** The order of a form, or an error message about what is missing. */
export function orderOf(robots: string[], form: Form): Order | string {
  if (robots.length === 0) return 'Choose robots, or enter names or a pattern.'
  if (robots.length > TARGETS) return `At most ${TARGETS} names go into one order. A pattern can match more: * means all your robots.`
  if (robots.filter((each) => !isName(each)).length > PATTERNS) return `At most ${PATTERNS} patterns and groups go into one order.`
  const said = (field: 'name' | 'type' | 'body' | 'why') => (FIELDS[form.do].includes(field) ? form[field].trim() : '')
  const [name, type, why] = [said('name'), said('type'), said('why')]
  const order: Order = { robots, do: form.do, ...(type === '' ? {} : { type }), ...(why === '' ? {} : { why }) }
  if (form.do === 'stop' || form.do === 'resume') return order
  if (name === '') return { call: 'Which service?', publish: 'Which topic?', set: 'Which parameter?', module: 'Which module?' }[form.do]
  if (form.do === 'module') return { ...order, module: name, action: form.action }
  if (form.do === 'set' && said('body') === '') return 'Which value?'
  try {
    return { ...order, [SUBJECTS[form.do]]: name, [BODIES[form.do]]: JSON.parse(said('body') || '{}') as unknown }
  } catch {
    return 'This is not JSON.'
  }
}

const AGAIN = 'Press STOP again, or stop the robots on site.'

/** How a stop of several robots ended: the message, and until when to show it (`Toast.until`). */
export interface StopEnd {
  kind: 'info' | 'error'
  words: string
  until: readonly string[] | null
}

export function stopEnd(progress: Progress): StopEnd {
  const rows = table(progress)
  if (rows.length === 0) {
    return { kind: 'error', words: `It is unknown which robots are stopped: the answer is incomplete. ${AGAIN}`, until: [] }
  }
  const missed = missedWords(progress)
  const failed = rows.filter(({ result }) => result?.ok !== true).map(({ robot }) => robot)
  if (failed.length > 0) {
    const words = [`Not confirmed to be stopped: ${people(failed, 5)}. ${AGAIN}`, missed].filter(Boolean).join(' ')
    return { kind: 'error', words, until: missed === '' ? failed : [] }
  }
  const later = rows.filter(({ result }) => result?.pending === true).length
  const now = rows.length - later
  const robots = (count: number) => (count === 1 ? '1 robot is' : `${count} robots are`)
  const sentences = [
    now > 0 || later === 0 ? `${robots(now)} stopped.` : '',
    later > 0 ? `${robots(later)} offline, and will be stopped when back.` : '',
    missed,
  ]
  const words = sentences.filter(Boolean).join(' ')
  return missed === '' ? { kind: 'info', words, until: null } : { kind: 'error', words, until: [] }
}
