/** The meaning of the close codes of the relay's websockets, and the reaction of the page (SPEC 1.4). */
import { sentence } from '../format'

export type After = 'login' | 'give_up' | 'retry'

export interface Ending {
  after: After
  words: string
}

const ENDINGS: Record<number, Ending> = {
  1001: { after: 'retry', words: 'The relay is restarting.' },
  4401: { after: 'login', words: 'Your session has ended. Please log in again.' },
  4403: { after: 'give_up', words: 'You no longer have a right to this robot.' },
  4404: { after: 'give_up', words: 'This robot does not exist, or you have no right on it.' },
  4408: { after: 'retry', words: 'This connection was too slow for the robot’s data.' },
}

/** Meaning of a closed websocket.
 *
 * @param code close code of the websocket
 * @param reason the reason of the relay, may be empty
 */
export function ending(code: number, reason: string): Ending {
  const known = ENDINGS[code] ?? { after: 'retry', words: 'The connection to the relay was lost.' }
  return code === 4403 ? withReason(known, reason) : known
}

/** The only code after which JPEG may work instead of H.264. */
export const NOT_AS_H264 = 4415

const VIDEO_ENDINGS: Record<number, Ending> = {
  1001: ENDINGS[1001]!,
  4400: { after: 'give_up', words: 'The camera cannot be shown with these settings.' },
  4401: ENDINGS[4401]!,
  4403: { after: 'give_up', words: 'You have no right to view this camera.' },
  4404: { after: 'give_up', words: 'This camera does not exist, or you may not view it.' },
  4408: { after: 'retry', words: 'This connection was too slow for the video.' },
  [NOT_AS_H264]: { after: 'retry', words: 'The robot cannot encode this camera as H.264.' },
  4429: { after: 'give_up', words: 'The relay accepts no more video streams now.' },
  4503: { after: 'retry', words: 'The camera cannot be shown now.' },
}

/** Meaning of the end of a camera's websocket.
 *
 * @param code close code of the websocket
 * @param reason the reason of the relay, may be empty
 */
export function videoEnding(code: number, reason: string): Ending {
  const known = VIDEO_ENDINGS[code] ?? { after: 'retry', words: 'The video connection was lost.' }
  // For a missing camera the reason of the relay says the same.
  return known.after === 'login' || code === 4404 ? known : withReason(known, reason)
}

function withReason(ending: Ending, reason: string): Ending {
  const added = sentence(reason)
  return added === '' ? ending : { ...ending, words: `${ending.words} ${added}` }
}
