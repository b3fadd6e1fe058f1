/** Foxglove URLs of a robot: made, listed and revoked (SPEC 1.19). */
import { ask, send } from './request'
import type { FoxgloveUrls, MadeFoxgloveUrl, NewFoxgloveUrl } from './types'

const HOUR = 3600
const DAY = 24 * HOUR

/** How long a URL may be valid, seconds. */
export const LIFETIMES: [number, string][] = [
  [HOUR, '1 hour'],
  [DAY, '1 day'],
  [30 * DAY, '30 days'],
  [365 * DAY, '1 year'],
]
export const USUAL_LIFETIME = 30 * DAY

export async function foxgloveUrls(robot: string): Promise<FoxgloveUrls> {
  return await ask('get', '/api/v1/robots/{robot}/foxglove-urls', { names: { robot } })
}

export async function makeFoxgloveUrl(robot: string, body: NewFoxgloveUrl): Promise<MadeFoxgloveUrl> {
  return await ask('post', '/api/v1/robots/{robot}/foxglove-urls', { names: { robot }, body })
}

export async function revokeFoxgloveUrl(robot: string, id: string): Promise<void> {
  await send('delete', '/api/v1/robots/{robot}/foxglove-urls/{id}', { names: { robot, id } })
}

/** Whether pages that were loaded by https, such as Foxglove's web app, can open a URL. Of plain ws:// addresses
 *  browsers let them open those of this computer only (W3C Secure Contexts, section 3.1). */
export function opensFromWeb(url: string): boolean {
  return /^(wss:\/\/|ws:\/\/(localhost|127\.0\.0\.1|\[::1\])[:/])/.test(url)
}
