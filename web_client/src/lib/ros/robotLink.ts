/** The link to one robot: a rosbridge websocket that reconnects, built on roslib.
 *
 * Every connection has its own `Ros`. roslib stores messages while it is disconnected, and sends them after a reconnect.
 * A `Ros` that is used for one connection never does, so no old command arrives late.
 */
import { AbstractTransport, Ros, Service, Topic } from 'roslib'
import { pause } from '../api/backoff'
import { ending, type Ending } from '../api/closeCodes'

export type LinkState = 'connecting' | 'open' | 'waiting' | 'ended'

/** Id of the status that the relay sends before a close frame. */
const CLOSED = 'closed'

/** Unsent bytes above which the link is stalled, so that a command would arrive late. */
const UNSENT_LIMIT = 4096

export interface RelayMessage {
  level: string
  words: string
}

export interface LinkEvents {
  state(state: LinkState, why: Ending | null): void
  /** A message of the relay in words, e.g. why it refused an operation. */
  received(message: RelayMessage): void
}

class SocketTransport extends AbstractTransport {
  constructor(readonly socket: WebSocket) {
    super()
    socket.binaryType = 'arraybuffer'
    socket.onopen = (event) => this.emit('open', event)
    socket.onclose = (event) => this.emit('close', event)
    socket.onerror = (event) => this.emit('error', event)
    socket.onmessage = (event) => this.handleRawMessage(event.data)
  }
  override send(message: object): void {
    this.socket.send(JSON.stringify(message))
  }
  override close(): void {
    this.socket.close()
  }
  override isConnecting(): boolean {
    return this.socket.readyState === WebSocket.CONNECTING
  }
  override isOpen(): boolean {
    return this.socket.readyState === WebSocket.OPEN
  }
  override isClosing(): boolean {
    return this.socket.readyState === WebSocket.CLOSING
  }
  override isClosed(): boolean {
    return this.socket.readyState === WebSocket.CLOSED
  }
}

interface Connection {
  ros: Ros
  socket: WebSocket
  publishers: Map<string, Topic<unknown>>
  /** Pending calls and goals, which fail when the connection closes. */
  calls: Set<(error: Error) => void>
}

interface Subscription {
  name: string
  type: string
  options: SubscribeOptions
  take: (message: never) => void
  topic: Topic<unknown> | null
}

/** `throttle_rate`, `queue_length` and `compression` of a subscription (SPEC 1.2). */
export interface SubscribeOptions {
  /** Least time between messages, 0 for all of them. */
  throttleMs?: number
  queueLength?: number
  /** `cbor` for long arrays of numbers; the relay may send JSON all the same. */
  compression?: 'none' | 'cbor'
}

/** The last answer to a goal. */
export interface GoalResult {
  /** 4 succeeded, 5 canceled, 6 aborted, 0: it never began. */
  status: number
  /** The result message; without one, the reason as a string. */
  values: unknown
}

/** A goal under way. */
export interface SentGoal {
  result: Promise<GoalResult>
  /** Asks for its end; the result still comes. */
  cancel(): void
}

let goalsSent = 0

export class Link {
  private connection: Connection | null = null
  private subscriptions = new Set<Subscription>()
  private stateNow: LinkState = 'connecting'
  private attempt = 0
  private timer: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly url: string,
    private readonly events: LinkEvents,
  ) {}

  get state(): LinkState {
    return this.stateNow
  }

  get isOpen(): boolean {
    return this.stateNow === 'open' && this.connection?.socket.readyState === WebSocket.OPEN
  }

  /** Bytes passed to the socket, but not sent yet. */
  get unsent(): number {
    return this.connection?.socket.bufferedAmount ?? 0
  }

  get isStalled(): boolean {
    return this.unsent > UNSENT_LIMIT
  }

  connect(): void {
    clearTimeout(this.timer)
    this.become('connecting', null)
    const socket = new WebSocket(this.url)
    const transport = new SocketTransport(socket)
    const ros = new Ros({ transportFactory: () => Promise.resolve(transport) })
    const connection: Connection = { ros, socket, publishers: new Map(), calls: new Set() }
    this.connection = connection
    ros.on('connection', () => this.opened(connection))
    // roslib swallows exceptions of message handlers; here they are reported.
    ros.on('error', (error) => {
      if (error instanceof Error) reportError(error)
    })
    ros.on('close', (event) => this.closed(connection, event as CloseEvent))
    void ros.connect(this.url)
    transport.on('message', (message) => this.listen(message))
  }

  /** Tries at once instead of waiting for the pause to end. */
  retryNow(): void {
    if (this.stateNow === 'waiting') this.connect()
  }

  /** Closes a silent connection, and connects again. */
  abandon(): void {
    const connection = this.connection
    if (connection === null) return
    connection.socket.close()
    // A dead link may take minutes to report its own close.
    this.closed(connection, { code: 1006, reason: '' })
  }

  close(): void {
    clearTimeout(this.timer)
    const socket = this.connection?.socket
    this.drop(new Error('The page was left.'))
    this.stateNow = 'ended'
    socket?.close(1000)
  }

  /** Receives a topic, across reconnects, until the returned function is called.
   *
   * @param options how; a number is the throttle in milliseconds
   */
  subscribe<T>(name: string, type: string, take: (message: T) => void, options: SubscribeOptions | number = {}): () => void {
    const chosen = typeof options === 'number' ? { throttleMs: options } : options
    const subscription: Subscription = { name, type, options: chosen, take, topic: null }
    this.subscriptions.add(subscription)
    if (this.isOpen) this.start(subscription)
    return () => {
      this.subscriptions.delete(subscription)
      if (this.isOpen) subscription.topic?.unsubscribe()
      subscription.topic = null
    }
  }

  /** Announces a topic before the first message, so that the robot is ready for it. */
  advertise(name: string, type: string): void {
    if (this.isOpen) this.publisher(name, type)?.advertise()
  }

  /** Publishes at once or not at all. Returns whether an open socket has taken the message. */
  publish(name: string, type: string, message: unknown): boolean {
    const topic = this.isOpen ? this.publisher(name, type) : null
    if (topic === null) return false
    topic.publish(message)
    return true
  }

  /** Calls a service.
   *
   * @param timeoutS seconds until the relay gives up
   * @throws Error in the relay's words, when the connection closes first, or a second after the relay should have given up
   */
  call<Q, A>(name: string, type: string, args: Q, timeoutS = 5): Promise<A> {
    const connection = this.connection
    if (!this.isOpen || connection === null) return Promise.reject(new Error('There is no connection.'))
    return new Promise<A>((resolve, reject) => {
      const done = <V>(settle: (value: V) => void) => (value: V) => {
        clearTimeout(timer)
        connection.calls.delete(fail)
        settle(value)
      }
      const fail: (error: Error) => void = done(reject)
      const timer = setTimeout(() => fail(new Error(`${name} did not answer.`)), (timeoutS + 1) * 1000)
      connection.calls.add(fail)
      new Service<Q, A>({ ros: connection.ros, name, serviceType: type }).callService(
        args,
        done(resolve),
        (words) => fail(new Error(words || `The call of ${name} failed.`)),
        timeoutS,
      )
    })
  }

  /** Sends a goal to an action. The robot cancels it when the connection is lost.
   *
   * roslib's `Action` merges status and result of a goal that failed into one text, so the messages are sent here.
   *
   * @throws Error when there is no connection; the result fails when it is lost
   */
  sendGoal<F>(action: string, type: string, goal: object, feedback: (values: F) => void): SentGoal {
    const connection = this.connection
    if (!this.isOpen || connection === null) throw new Error('There is no connection.')
    const { ros, calls } = connection
    const id = `send_action_goal:${action}:${++goalsSent}`
    const result = new Promise<GoalResult>((resolve, reject) => {
      calls.add(reject)
      ros.on(id, (message: object) => {
        const { op, values, status } = message as { op: string; values: unknown; status?: number }
        if (op === 'action_feedback') feedback(values as F)
        if (op !== 'action_result') return
        calls.delete(reject)
        resolve({ status: status ?? 0, values })
      })
    })
    ros.callOnConnection({ op: 'send_action_goal', id, action, action_type: type, args: goal, feedback: true })
    const cancel = () => {
      if (connection === this.connection && this.isOpen) ros.callOnConnection({ op: 'cancel_action_goal', id, action })
    }
    return { result, cancel }
  }

  private publisher(name: string, type: string): Topic<unknown> | null {
    const connection = this.connection
    if (connection === null) return null
    let topic = connection.publishers.get(name)
    if (topic === undefined) {
      topic = new Topic({ ros: connection.ros, name, messageType: type, queue_size: 1, reconnect_on_close: false })
      connection.publishers.set(name, topic)
    }
    return topic
  }

  private start(subscription: Subscription): void {
    if (this.connection === null) return
    const { name, type, options, take } = subscription
    subscription.topic = new Topic<unknown>({
      ros: this.connection.ros,
      name,
      messageType: type,
      throttle_rate: options.throttleMs ?? 0,
      queue_length: options.queueLength ?? 1,
      compression: options.compression ?? 'none',
      reconnect_on_close: false,
    })
    subscription.topic.subscribe(take as (message: unknown) => void)
  }

  private opened(connection: Connection): void {
    if (connection !== this.connection) return
    this.attempt = 0
    connection.ros.setStatusLevel('warning')
    this.become('open', null)
    for (const subscription of this.subscriptions) this.start(subscription)
  }

  private closed(connection: Connection, event: Pick<CloseEvent, 'code' | 'reason'>): void {
    if (connection !== this.connection) return
    const why = ending(event.code, event.reason)
    this.drop(new Error(why.words))
    if (why.after !== 'retry') {
      this.become('ended', why)
      return
    }
    this.become('waiting', why)
    this.timer = setTimeout(() => this.connect(), pause(this.attempt++, Math.random()))
  }

  private drop(error: Error): void {
    for (const reject of this.connection?.calls ?? []) reject(error)
    this.connection = null
    for (const subscription of this.subscriptions) subscription.topic = null
  }

  /** roslib emits status messages by their id only, which is not known in advance. */
  private listen(message: { op: string; id?: unknown; level?: unknown; msg?: unknown }): void {
    if (message.op !== 'status' || typeof message.msg !== 'string') return
    // The close frame that follows has the same reason.
    if (message.id === CLOSED) return
    this.events.received({ level: String(message.level), words: message.msg })
  }

  private become(state: LinkState, why: Ending | null): void {
    this.stateNow = state
    this.events.state(state, why)
  }
}
