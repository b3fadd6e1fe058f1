/** Stops by a websocket of their own.
 *
 * Browsers allow six HTTP/1.1 connections to a host, over all tabs. Camera streams in other tabs can hold all of them; then
 * a request waits until one ends. Websockets have a limit of their own, which is far higher.
 */
import { ending } from './closeCodes'
import { newStopId } from '../control/control'
import { sentence } from '../format'
import { fleetSocket, robotSocket, STOP_TIMEOUT_MS } from './api'
import { ReceiveTimeout } from '../timeoutSignal'
import { Refusal, Unreachable } from './request'
import type { Order, OrderLine } from './types'

const STOP = 'switchboard_msgs/srv/Stop'

interface Answer {
  op?: string
  id?: string
  result?: boolean
  values?: { success: boolean; done: boolean; message: string; stopped: object | null } | string
}

/** Stops a robot over a new websocket. Returns whether the stop is pending, because the robot is offline.
 *
 * @param stopId the id of the press, the same on all paths
 * @param signal ends the attempt: the robot is stopped already
 * @throws Refusal the relay's reason
 * @throws Unreachable the connection failed, or no answer came for longer than the relay ever takes
 */
export async function stopBySocket(name: string, why = '', stopId = newStopId(), signal?: AbortSignal): Promise<boolean> {
  const socket = new WebSocket(robotSocket(name, location))
  const patience = new ReceiveTimeout(STOP_TIMEOUT_MS, signal)
  try {
    return await new Promise<boolean>((resolve, reject) => {
      patience.signal.addEventListener('abort', () => reject(new Unreachable()))
      socket.onopen = () => socket.send(JSON.stringify(order(why, stopId)))
      socket.onclose = ({ code, reason }) => {
        const { after, words } = ending(code, reason)
        reject(after === 'retry' ? new Unreachable() : new Refusal(after === 'login' ? 401 : 403, words))
      }
      socket.onmessage = ({ data }) => {
        const answer = answerOf(data, stopId)
        if (answer !== null) settle(answer, resolve, reject)
      }
    })
  } finally {
    patience.end()
    socket.onopen = socket.onclose = null
    socket.close()
  }
}

/** Gives an order to stop over a new websocket (SPEC 1.7-26).
 *
 * @param take each line of the answer
 * @param signal ends the attempt
 * @throws Refusal the relay's reason
 * @throws Unreachable the connection failed, or no line came for longer than the relay ever takes
 */
export async function stopAllBySocket(order: Order, take: (line: OrderLine) => void, signal?: AbortSignal): Promise<void> {
  const socket = new WebSocket(fleetSocket(location))
  const patience = new ReceiveTimeout(STOP_TIMEOUT_MS, signal)
  try {
    await new Promise<void>((resolve, reject) => {
      patience.signal.addEventListener('abort', () => reject(new Unreachable()))
      socket.onopen = () => socket.send(JSON.stringify(order))
      socket.onclose = ({ code, reason }) => {
        const words = sentence(reason)
        reject(code < 4000 || words === '' ? new Unreachable() : new Refusal(code === 4401 ? 401 : 403, words))
      }
      socket.onmessage = ({ data }) => {
        const { event, data: line } = JSON.parse(data as string) as { event: string; data: OrderLine }
        if (event !== 'order') return
        patience.begin()
        take(line)
        if ('done' in line) resolve()
      }
    })
  } finally {
    patience.end()
    socket.onopen = socket.onclose = socket.onmessage = null
    socket.close()
  }
}

function order(why: string, stopId: string): object {
  return { op: 'call_service', id: stopId, service: '/relay/stop', type: STOP, args: { why, stop_id: stopId } }
}

/** The answer to the stop; null for anything else. */
function answerOf(data: unknown, stopId: string): Answer | null {
  if (typeof data !== 'string') return null
  const message = JSON.parse(data) as Answer
  return message.op === 'service_response' && message.id === stopId ? message : null
}

function settle({ result, values }: Answer, resolve: (later: boolean) => void, reject: (error: Error) => void): void {
  if (typeof values === 'object' && result === true && values.success) resolve(!values.done)
  // As over HTTP: 409 means that the robot is stopped, but could not do a part of it.
  else if (typeof values === 'object') reject(new Refusal(values.stopped === null ? 503 : 409, values.message))
  else reject(new Refusal(403, values ?? ''))
}
