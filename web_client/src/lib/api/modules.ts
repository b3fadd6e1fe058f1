/** Modules and processes of a robot, without user interface. */
import type { Level } from '../logPages'
import { pauseFor } from './pause'
import { ask } from './request'
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

/** Milliseconds between two requests for the list of modules, and where the user may manage none. */
const MODULES_MS = 1000
const NO_MODULES_MS = 5000
/** Milliseconds between two requests for new lines of a log. */
const LOG_MS = 1000

/** Passes on the modules again and again, until the signal ends.
 *
 * Requests end. An event stream would hold one of the six connections of HTTP/1.1 that a browser opens to a host.
 */
export async function followModules(robot: string, take: (list: ModuleList) => void, signal: AbortSignal): Promise<never> {
  for (;;) {
    const list = (await ask('get', '/api/v1/robots/{robot}/modules', { names: { robot }, signal })) as ModuleList
    take(list)
    await pauseFor(list.modules.length > 0 ? MODULES_MS : NO_MODULES_MS, signal)
  }
}

/** Lines of a log.
 *
 * @param where `before`: `previous` of a later page; `after`: `next` of an earlier one; without: the newest lines
 */
export async function readLog(
  robot: string,
  module: string,
  level: Level,
  where: { before?: number; after?: number } = {},
  signal?: AbortSignal,
): Promise<LogPage> {
  const options = { names: { robot, module }, query: { level, ...where }, signal }
  return ask('get', '/api/v1/robots/{robot}/modules/{module}/log', options)
}

/** Passes on the lines of a log that have been written since, again and again; a page may have no lines.
 *
 * @param after `next` of an earlier page
 */
export async function followLog(
  robot: string,
  module: string,
  level: Level,
  after: number,
  take: (page: LogPage) => void,
  signal: AbortSignal,
): Promise<never> {
  for (let next = after; ; ) {
    const page = await readLog(robot, module, level, { after: next }, signal)
    take(page)
    // The relay looks through a part of the log at a time, so that a page without lines may not be the last one.
    if (page.next === next) await pauseFor(LOG_MS, signal)
    next = page.next
  }
}

/** Passes on measurements of all processes, with their shares of a CPU since the one before.
 *
 * @param every seconds
 */
export async function followProcesses(robot: string, every: number, take: (list: ProcessList) => void, signal: AbortSignal): Promise<never> {
  const shares = new ProcessShares()
  for (;;) {
    const began = performance.now()
    const list = await ask('get', '/api/v1/robots/{robot}/processes', { names: { robot }, signal })
    take({ ...list, processes: shares.measured(list.processes as ProcessStatus[]) })
    await pauseFor(Math.max(0, 1000 * every - (performance.now() - began)), signal)
  }
}

/** Shares of a CPU between two measurements of this page, per cent; null for a process that the one before did not have. */
export class ProcessShares {
  private before = new Map<string, ProcessStatus>()

  measured(processes: ProcessStatus[]): ProcessStatus[] {
    // A number of a process is used again.
    const key = ({ pid, created }: ProcessStatus) => `${pid} ${created}`
    const rows = processes.map((now) => ({ ...now, cpu: share(now, this.before.get(key(now))) }))
    this.before = new Map(processes.map((each) => [key(each), each]))
    return rows
  }
}

function share(now: ProcessStatus, before: ProcessStatus | undefined): number | null {
  if (before === undefined || now.read_at <= before.read_at || now.busy < before.busy) return null
  return (100 * (now.busy - before.busy)) / (now.read_at - before.read_at)
}
