/** Stops by every path at once: each may be blocked, in the browser or between it and the relay. */
import { giveOrder, stopRobot } from '../api/api'
import type { OrderLine } from '../api/types'
import { Refusal } from '../api/request'
import { stopBySocket } from '../api/stopSocket'
import { firstSuccess, newStopId } from './control'

/** Milliseconds without any answer after which robots are also stopped one by one. */
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

/** Stops all robots of the user by one order, and one by one if that gets no answer.
 *
 * @param known names of the robots that the page knows
 * @param take each line of the answer to the order
 * @param stopped a robot that was stopped by itself
 * @throws Unreachable the order got no answer, or the answer broke off
 */
export async function stopAll(known: string[], take: (line: OrderLine) => void, stopped: (name: string) => void): Promise<void> {
  const stopId = newStopId()
  const each: Promise<void>[] = []
  const timer = setTimeout(() => {
    for (const name of known) {
      const confirmed = stopBySocket(name, '', stopId).then((later) => (later ? undefined : stopped(name)))
      each.push(confirmed.catch(() => undefined))
    }
  }, UNANSWERED_MS)
  try {
    await giveOrder({ robots: ['*'], do: 'stop', stop_id: stopId }, (line) => {
      clearTimeout(timer)
      take(line)
    })
  } catch (error) {
    await Promise.all(each)
    throw error
  } finally {
    clearTimeout(timer)
  }
}

function isRefusal(error: unknown): boolean {
  return error instanceof Refusal
}
