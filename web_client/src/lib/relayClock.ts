/** The relay's clock, by the `Date` of its answers. Times in the portal are the relay's, and the clock of a user's device may be wrong. */

/** Bounds of what is to be added to the device's clock, milliseconds. */
let [least, most] = [-Infinity, Infinity]

/** Learns from an answer.
 *
 * @param date its `Date`, in whole seconds
 * @param sentMs when the request was sent by the device's clock, Unix milliseconds
 */
export function learnRelayTime(date: string | null, sentMs: number, receivedMs = Date.now()): void {
  const second = Date.parse(date ?? '')
  if (Number.isNaN(second)) return
  const [low, high] = [second - receivedMs, second + 1000 - sentMs]
  const agrees = low <= most && high >= least
  // If it does not agree, one of the clocks was set.
  least = agrees ? Math.max(least, low) : low
  most = agrees ? Math.min(most, high) : high
}

/** The relay's time, Unix seconds. The device's clock is corrected only as far as it is seen to be wrong. */
export function relayTime(): number {
  return (Date.now() + Math.min(Math.max(0, least), most)) / 1000
}
