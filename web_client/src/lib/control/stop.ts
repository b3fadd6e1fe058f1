/** Stops by every path at once: each may be blocked, in the browser or between it and the relay. */
import { giveOrder, stopRobot } from '../api/api'
import { after, NOTHING_YET, type Progress } from '../api/fleetOrders'
import type { Order, OrderLine } from '../api/types'
import { Refusal, Unreachable } from '../api/request'
import { stopAllBySocket, stopBySocket } from '../api/stopSocket'
import { firstSuccess, newStopId } from './control'

/** Milliseconds without an answer after which a stop is shown as not confirmed. */
export const UNANSWERED_MS = 1000

/** Stops a robot by HTTP and by a new websocket. Returns whether the stop is pending, because the robot is offline.
 *
 * @param stopId the id of the press, the same on all paths
 * @param more further paths of the same press
 * @throws the error that has a reason, else the first
 */
export async function stopByAllPaths(
  name: string,
  stopId = newStopId(),
  more: Promise<boolean>[] = [],
  hasReason: (error: unknown) => boolean = isRefusal,
): Promise<boolean> {
  // A request that waits for a connection must not stop the robot again, minutes after it was resumed.
  const rest = new AbortController()
  const paths = [stopRobot, stopBySocket].map((stop) => stop(name, '', stopId, rest.signal))
  const result = await firstSuccess([...more, ...paths], hasReason)
  rest.abort()
  return result
}

/** Stops many robots by HTTP, by a new websocket and by the one of the live updates. Returns the first complete answer.
 *
 * If there is none, returns the longest one with the error that has a reason, else the first error.
 *
 * @param stop names, patterns or groups, and a reason
 * @param sendOpen sends the order on a websocket that is open, without its answer
 * @param show called with each progress
 */
export async function stopMany(
  stop: Pick<Order, 'robots' | 'why'>,
  sendOpen: (order: Order) => void = () => {},
  show: (progress: Progress) => void = () => {},
): Promise<{ progress: Progress; failure: unknown }> {
  const order: Order = { ...stop, do: 'stop', stop_id: newStopId() }
  const rest = new AbortController()
  let longest = NOTHING_YET
  sendOpen(order)
  const paths = [giveOrder, stopAllBySocket].map(async (give) => {
    let progress = NOTHING_YET
    const take = (line: OrderLine) => {
      progress = after(progress, line)
      if (progress.results.length < longest.results.length) return
      longest = progress
      show(longest)
    }
    await give(order, take, rest.signal)
    if (!progress.done) throw new Unreachable()
    return progress
  })
  try {
    return { progress: await firstSuccess(paths, isRefusal), failure: null }
  } catch (failure) {
    return { progress: longest, failure }
  } finally {
    rest.abort()
  }
}

function isRefusal(error: unknown): boolean {
  return error instanceof Refusal
}
