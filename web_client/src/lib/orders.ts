/** One order to many robots: what is asked, and the lines of the answer (protocol/SPEC.md 1.11). */
import { people, sentence } from './format'

export type Do = 'stop' | 'resume' | 'call' | 'publish' | 'set'

export interface Order {
  robots: string[]
  do: Do
  service?: string
  topic?: string
  type?: string
  args?: unknown
  msg?: unknown
  name?: string
  value?: unknown
  why?: string
}

export interface Result {
  robot: string
  ok: boolean
  message: string
  values: unknown
  pending: boolean
  seconds: number
}

export interface Progress {
  /** All that are meant; null before the relay told them. */
  meant: string[] | null
  /** What of the order means no robot. */
  unmatched: string[]
  /** Why robots may be meant that are not told, in the relay's words; empty when none are. */
  missed: string
  results: Result[]
  /** Whether the answer came whole. */
  done: boolean
}

export const NOTHING_YET: Progress = { meant: null, unmatched: [], missed: '', results: [], done: false }

/** The lines of an answer as they come, in whatever pieces. */
export class Lines {
  private rest = ''

  /** The whole lines that a piece completes; a line that is no object is passed over. */
  take(text: string): object[] {
    const parts = (this.rest + text).split('\n')
    this.rest = parts.pop() ?? ''
    return parts.flatMap((part) => parsed(part))
  }
}

function parsed(text: string): object[] {
  if (text.trim() === '') return []
  try {
    const value: unknown = JSON.parse(text)
    return typeof value === 'object' && value !== null && !Array.isArray(value) ? [value] : []
  } catch {
    return []
  }
}

/** What is known after one more line. */
export function after(progress: Progress, line: object): Progress {
  const { robots, unmatched, missed, robot, done } = line as Record<string, unknown>
  if (done === true) return { ...progress, done: true }
  if (typeof robot === 'string') return { ...progress, results: [...progress.results, line as Result] }
  if (!Array.isArray(robots)) return progress
  return { ...progress, meant: words(robots), unmatched: words(unmatched), missed: typeof missed === 'string' ? missed : '' }
}

function words(list: unknown): string[] {
  return Array.isArray(list) ? list.filter((each) => typeof each === 'string') : []
}

/** What of an order means no robot, in a sentence; empty where all of it means some. */
export function unmatchedWords({ unmatched }: Progress): string {
  return unmatched.length === 0 ? '' : `No robot of yours is meant by ${people(unmatched, 5)}.`
}

/** That robots may have been left out of an order, and why; empty where none were. */
export function missedWords({ missed }: Progress): string {
  return missed === '' ? '' : `Others of yours may not be reached by it. ${sentence(missed)}`
}

/** What became of each robot that is meant: its result, or null while there is none. */
export function table({ meant, results }: Progress): { robot: string; result: Result | null }[] {
  const found = new Map(results.map((result) => [result.robot, result]))
  const names = meant ?? [...found.keys()]
  return names.map((robot) => ({ robot, result: found.get(robot) ?? null }))
}

/** Names, patterns and groups, as people write them: apart by commas or spaces. */
export function targets(text: string): string[] {
  return Array.from(new Set(text.split(/[\s,]+/).filter(Boolean)))
}

export interface Form {
  do: Do
  /** Name of the service, topic or parameter. */
  name: string
  type: string
  /** JSON. */
  body: string
  why: string
}

/** What the relay takes (SPEC 1.11). */
const TARGETS = 1000
const PATTERNS = 64

function isName(target: string): boolean {
  return !target.startsWith('group:') && !/[*?[]/.test(target)
}

/** What an order is about, as the relay calls it; with that, whatever else a kind of order may have (SPEC 1.11). */
const SUBJECTS = { call: 'service', publish: 'topic', set: 'name' } as const
const BODIES = { call: 'args', publish: 'msg', set: 'value' } as const

/** The fields of the form that go with each kind of order: these are shown, and no others sent. */
export const FIELDS: Record<Do, readonly (keyof Omit<Form, 'do'>)[]> = {
  stop: ['why'],
  resume: ['why'],
  call: ['name', 'type', 'body', 'why'],
  publish: ['name', 'type', 'body'],
  set: ['name', 'body'],
}

/** The order a form asks for, or what is missing in words. */
export function orderOf(robots: string[], form: Form): Order | string {
  if (robots.length === 0) return 'Choose robots, or write their names or a pattern.'
  if (robots.length > TARGETS) return `At most ${TARGETS} names go into one order. A pattern means more: * all your robots.`
  if (robots.filter((each) => !isName(each)).length > PATTERNS) return `At most ${PATTERNS} patterns and groups go into one order.`
  const said = (field: 'name' | 'type' | 'body' | 'why') => (FIELDS[form.do].includes(field) ? form[field].trim() : '')
  const [name, type, why] = [said('name'), said('type'), said('why')]
  const order: Order = { robots, do: form.do, ...(type === '' ? {} : { type }), ...(why === '' ? {} : { why }) }
  if (form.do === 'stop' || form.do === 'resume') return order
  if (name === '') return { call: 'Which service?', publish: 'Which topic?', set: 'Which parameter?' }[form.do]
  if (form.do === 'set' && said('body') === '') return 'Which value?'
  try {
    return { ...order, [SUBJECTS[form.do]]: name, [BODIES[form.do]]: JSON.parse(said('body') || '{}') as unknown }
  } catch {
    return 'That is no JSON.'
  }
}

const AGAIN = 'Press STOP again, or stop them where they are.'

/** What became of an order to stop: what to say, and until when (`Toast.until`). */
export interface StopEnd {
  kind: 'info' | 'error'
  words: string
  until: readonly string[] | null
}

export function stopEnd(progress: Progress): StopEnd {
  const rows = table(progress)
  if (rows.length === 0) {
    return { kind: 'error', words: `No robot is known to be stopped: the answer broke off. ${AGAIN}`, until: [] }
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
    later > 0 ? `${robots(later)} away, and will be stopped when back.` : '',
    missed,
  ]
  const words = sentences.filter(Boolean).join(' ')
  return missed === '' ? { kind: 'info', words, until: null } : { kind: 'error', words, until: [] }
}
