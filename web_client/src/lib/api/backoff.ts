/** Growing pauses between attempts to connect. */

const FIRST_MS = 500
const LONGEST_MS = 15_000

/** Pause before an attempt, in milliseconds, spread by ±25 % so that many pages do not reconnect at the same time.
 *
 * @param attempt 0 for the first attempt after a loss
 * @param random a number from 0 to 1
 */
export function pause(attempt: number, random: number): number {
  const grown = Math.min(LONGEST_MS, FIRST_MS * 2 ** Math.min(attempt, 10))
  return Math.round(grown * (0.75 + random / 2))
}
