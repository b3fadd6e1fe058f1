/** What the close codes of a robot's websocket mean, and what to do about them. */
import { sentence } from './format'

export type After = 'login' | 'give_up' | 'retry'

export interface Ending {
  after: After
  words: string
}

const ENDINGS: Record<number, Ending> = {
  1001: { after: 'retry', words: 'The relay is restarting.' },
  4401: { after: 'login', words: 'Your session has ended. Please log in again.' },
  4403: { after: 'give_up', words: 'You no longer have a right to this robot.' },
  4404: { after: 'give_up', words: 'There is no robot of this name for you.' },
  4408: { after: 'retry', words: 'This connection was too slow for what the robot sends.' },
}

/** Tells what a closed websocket means.
 *
 * @param code close code of the websocket
 * @param reason the relay's own words, may be empty
 */
export function ending(code: number, reason: string): Ending {
  const known = ENDINGS[code] ?? { after: 'retry', words: 'The connection to the relay was lost.' }
  const added = reason.trim()
  if (code !== 4403 || added === '') return known
  return { ...known, words: `${known.words} ${sentence(added)}` }
}
