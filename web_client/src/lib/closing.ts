/** What the close codes of the relay's websockets mean, and what to do about them (protocol/SPEC.md 1.4). */
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
  return code === 4403 ? withReason(known, reason) : known
}

/** Of the codes only this one says that JPEG may do where H.264 does not. */
export const NOT_AS_H264 = 4415

const VIDEO_ENDINGS: Record<number, Ending> = {
  1001: ENDINGS[1001]!,
  4400: { after: 'give_up', words: 'The camera can’t be shown like that.' },
  4401: ENDINGS[4401]!,
  4403: { after: 'give_up', words: 'You have no right to view this camera.' },
  4404: { after: 'give_up', words: 'There is no camera of this name for you.' },
  4408: { after: 'retry', words: 'This connection was too slow for the pictures.' },
  [NOT_AS_H264]: { after: 'retry', words: 'The robot can’t make H.264 of this camera.' },
  4429: { after: 'give_up', words: 'The relay shows no more pictures for now.' },
  4503: { after: 'retry', words: 'The camera can’t be shown now.' },
}

/** Tells what the end of a camera's websocket means.
 *
 * @param code close code of the websocket
 * @param reason the relay's own words, may be empty
 */
export function videoEnding(code: number, reason: string): Ending {
  const known = VIDEO_ENDINGS[code] ?? { after: 'retry', words: 'The connection for the pictures was lost.' }
  // Of what is not there the relay says the same in other words.
  return known.after === 'login' || code === 4404 ? known : withReason(known, reason)
}

function withReason(ending: Ending, reason: string): Ending {
  const added = sentence(reason)
  return added === '' ? ending : { ...ending, words: `${ending.words} ${added}` }
}
