/** Modules and processes of a robot, without user interface. */
import type { Level } from '../logPages'
import { readEvents } from './events'
import { ask, send } from './request'
import type { LogPage, ModuleList, ModuleStatus, ProcessStatus, ProcessList } from './types'

export type ModuleAction = 'start' | 'stop' | 'restart'

/** Words and tone of the states of a module (SPEC 2.4). */
export const STATES: Record<string, { words: string; tone: '' | 'good' | 'warn' | 'bad' }> = {
  stopped: { words: 'stopped', tone: '' },
  waiting: { words: 'waiting', tone: 'warn' },
  starting: { words: 'starting', tone: 'warn' },
  running: { words: 'running', tone: 'good' },
  stopping: { words: 'stopping', tone: 'warn' },
  backing_off: { words: 'restarting soon', tone: 'bad' },
  failed: { words: 'failed', tone: 'bad' },
  unknown: { words: 'unknown', tone: '' },
}

/** Seconds between two measurements that can be chosen. */
export const INTERVALS = [0.1, 0.5, 1, 2, 5, 10]

export function isUp(module: ModuleStatus): boolean {
  return ['waiting', 'starting', 'running', 'backing_off'].includes(module.state)
}

/** Orders that change something, by the state of a module (SPEC 2.4). */
const ORDERS: Record<string, ModuleAction[]> = {
  stopped: ['start'],
  waiting: ['stop'],
  starting: ['stop', 'restart'],
  running: ['stop', 'restart'],
  // At once, instead of after the pause.
  backing_off: ['start', 'stop'],
  // Stopped it is not wanted any more, which ends its alert.
  failed: ['start', 'stop'],
}

/** The orders to offer. While an order is pending, only its opposite, which replaces it. */
export function ordersFor(module: ModuleStatus): ModuleAction[] {
  if (module.pending) return [module.pending.action === 'start' ? 'stop' : 'start']
  if (module.state === 'stopping') return module.wanted ? ['stop'] : ['start']
  return ORDERS[module.state] ?? ['start', 'stop']
}

export type Column = Exclude<keyof ProcessStatus, 'parent' | 'busy' | 'read_at'>

/** Rows in the order of a column: text upwards, numbers downwards, and the reverse. */
export function sorted(processes: ProcessStatus[], by: Column, reverse: boolean): ProcessStatus[] {
  const order = (a: ProcessStatus, b: ProcessStatus) =>
    by === 'part' || by === 'name' || by === 'state' ? a[by].localeCompare(b[by]) : (b[by] ?? 0) - (a[by] ?? 0)
  const found = [...processes].sort((a, b) => order(a, b) || a.pid - b.pid)
  return reverse ? found.reverse() : found
}

/** Why the order is pending, in words; empty if the robot has accepted it. */
export async function orderModule(robot: string, module: string, action: ModuleAction): Promise<string> {
  const names = { robot, module, action }
  const done = await ask('post', '/api/v1/robots/{robot}/modules/{module}/{action}', { names })
  return done.pending ? (done.why ?? '') : ''
}

const STREAM = { headers: { Accept: 'text/event-stream' } }

/** Passes on the modules, now and after every change, until the signal or the stream ends. */
export async function followModules(robot: string, take: (list: ModuleList) => void, signal: AbortSignal): Promise<void> {
  const answer = await send('get', '/api/v1/robots/{robot}/modules', { names: { robot }, ...STREAM, signal })
  await readEvents(answer, (name, data) => name === 'modules' && take(data as ModuleList))
}

/** Lines of a log.
 *
 * @param before `previous` of a later page; undefined for the newest lines
 */
export async function readLog(robot: string, module: string, level: Level, before?: number, signal?: AbortSignal): Promise<LogPage> {
  const options = { names: { robot, module }, query: { level, before }, signal }
  return ask('get', '/api/v1/robots/{robot}/modules/{module}/log', options)
}

/** Passes on lines of a log as they are written.
 *
 * @param after `next` of an earlier page
 * @param opened called when the relay has accepted
 */
export async function followLog(
  robot: string,
  module: string,
  level: Level,
  after: number,
  opened: () => void,
  take: (page: LogPage) => void,
  signal: AbortSignal,
): Promise<void> {
  const options = { names: { robot, module }, query: { level, after }, ...STREAM, signal }
  const answer = await send('get', '/api/v1/robots/{robot}/modules/{module}/log', options)
  opened()
  await readEvents(answer, (name, data) => name === 'lines' && take(data as LogPage))
}

/** Passes on measurements of all processes.
 *
 * @param every seconds
 */
export async function followProcesses(robot: string, every: number, take: (list: ProcessList) => void, signal: AbortSignal): Promise<void> {
  const options = { names: { robot }, query: { every }, ...STREAM, signal }
  const answer = await send('get', '/api/v1/robots/{robot}/processes', options)
  await readEvents(answer, (name, data) => name === 'processes' && take(data as ProcessList))
}
