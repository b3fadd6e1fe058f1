/** The relays that serve the same robots, without user interface. */
import { ask, Refusal } from './request'
import type { ClusterState, RelayStatus } from './types'

type State = RelayStatus['state']

/** Tone of each state. */
export const TONES: Record<State, 'good' | 'warn' | 'bad'> = {
  ready: 'good',
  draining: 'warn',
  incompatible: 'bad',
  silent: 'bad',
}

/** What each state means for robots and clients. */
export const MEANINGS: Record<State, string> = {
  ready: '',
  draining: 'Its robots and clients are moved to the other relays. It can be stopped when it has none.',
  incompatible: 'Its version and that of this relay can\u2019t work together. Upgrade relays one version at a time.',
  silent: 'It has not answered within 2 s. If it has ended, its robots connect to the other relays by themselves.',
}

/** Age above which changes of rights count as late, seconds. */
const LATE_SECONDS = 2
/** Share of one core above which a relay should get no more robots. */
const BUSY = 0.8

export const isLate = ({ load }: RelayStatus) => (load?.lag_s ?? 0) > LATE_SECONDS
export const isBusy = ({ load }: RelayStatus) => (load?.cpu ?? 0) > BUSY

/** The age of the newest change that a relay may not have read, in words. */
export function lagWords(seconds: number): string {
  if (seconds < 0.95) return `${Math.round(seconds * 1000)} ms`
  if (seconds < 60) return `${seconds.toFixed(1)} s`
  return seconds < 3600 ? `${Math.floor(seconds / 60)} min` : 'over an hour'
}

/** Figures of all relays together. Relays that did not answer count with the robots that are known to be theirs. */
export function totals(relays: readonly RelayStatus[]): { robots: number; clients: number } {
  return {
    robots: relays.reduce((sum, { load, homes }) => sum + (load?.robots ?? homes), 0),
    clients: relays.reduce((sum, { load }) => sum + (load?.clients ?? 0), 0),
  }
}

/** The relays of the cluster; null if this relay is the only one. */
export async function cluster(): Promise<ClusterState | null> {
  try {
    return (await ask('get', '/api/v1/cluster')) as ClusterState
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return null
    throw error
  }
}
