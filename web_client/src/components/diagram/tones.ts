import type { RoleRun } from '../../lib/api/types'

/** Tone of each state of a Role. */
export const RUN_TONES: Record<RoleRun['state'], '' | 'good' | 'warn' | 'bad'> = {
  running: 'good',
  starting: 'warn',
  partial: 'warn',
  ended: 'bad',
  stopped: '',
}
