/** Control of one robot by this page: holder, driving, stop and resume. */
import { app } from './appStore.svelte.ts'
import * as control from '../control/control'
import { stopByAllPaths, UNANSWERED_MS } from '../control/stop'
import { Drive, type Limits, type Source, type StopReason, stopWords } from '../control/drive'
import type { Link } from '../ros/robotLink'
import { sentence } from '../format'
import { Refusal } from '../api/request'
import { recall, remember } from './storage'
import { fullType } from '../ros/topics'
import type { Control, Level, Stopped } from '../api/types'
import type { ControlReply, TopicInfo, Twist } from '../ros/messages'

const ORDER = 'switchboard_msgs/srv/Order'
const REPLY = 'switchboard_msgs/srv/Reply'
const STOP = 'switchboard_msgs/srv/Stop'
const USUAL: Limits = { linear: 0.5, angular: 1 }

type Order = 'take_control' | 'release_control' | 'grant_control' | 'refuse_control' | 'resume'

/** State of a stop of this page. Its message takes precedence over all others. */
const STOP_STATES = {
  going: 'Stopping…',
  unanswered: 'The stop is not confirmed yet. If the robot moves, stop it on site.',
  done: 'The robot is stopped.',
  later: 'The robot is offline. It is stopped as soon as it is online.',
  unsure: 'The stop is not confirmed. Press STOP again, or stop the robot on site.',
} as const

/** The part of the cockpit that the store needs. */
export interface Bridge {
  readonly name: string
  readonly link: Link
  readonly level: Level | null
  readonly offline: boolean
  readonly motion: TopicInfo | null
  /** Why driving is not possible from this page, apart from control; null if it is. */
  readonly why: string | null
  /** Unix time in seconds by the relay's clock, updated as often as the page shows it. */
  readonly unixS: number
  isLate(): boolean
  /** The relay answers in time and the robot does not. */
  isRobotLate(): boolean
}

export class ControlStore {
  /** Last state from the relay; null before the first, and without a link. */
  control = $state.raw<Control | null>(null)
  driving = $state(false)
  /** Why driving ended last, in words. */
  words = $state<string | null>(null)
  /** State of the last stop of this page; null when it is settled. */
  stopState = $state<keyof typeof STOP_STATES | null>(null)
  /** Whether a stop was sent and is not answered yet. */
  readonly isStopping = $derived(this.stopState === 'going' || this.stopState === 'unanswered')
  readonly stopWords = $derived(this.stopState === null ? null : STOP_STATES[this.stopState])
  /** Changes when every input must be released. */
  releaseCount = $state(0)
  /** Whether the focused element takes keys that would otherwise drive or stop. */
  keysTaken = $state(false)
  chosen = $state<Limits>(USUAL)
  /** The order that is being carried out. */
  busy = $state<Order | null>(null)
  /** Why the relay refused the last order, in its words. */
  answer = $state<string | null>(null)

  readonly state = $derived.by(() =>
    control.controlState(this.control, app.session?.user ?? '', this.bridge.level, this.bridge.unixS),
  )
  readonly sentence = $derived.by(() => control.sentenceOf(this.control, this.state, this.bridge.unixS))
  readonly isMine = $derived(control.isYours(this.control))
  readonly mayControl = $derived.by(() => this.control?.you.may_control ?? this.bridge.level !== 'viewer')
  readonly mayResume = $derived(this.control?.you.may_resume === true)
  readonly stopped = $derived(this.control?.stopped ?? null)
  /** The user that suppresses the chosen topic; null for none. */
  readonly suppressor = $derived.by(() => control.suppressor(this.control, this.bridge.motion?.name ?? null))
  /** The robot's limits for this user. */
  readonly top = $derived.by(() => control.topOf(this.control, this.bridge.level))
  readonly limits = $derived(control.within(this.chosen, this.top))
  /** Why the controls are disabled, or null. */
  readonly blocked = $derived.by(() => this.bridge.why ?? this.whyNotMine())

  private readonly drive: Drive
  private givingAway = false
  private reportedLoss: string | null = null
  private presses = 0

  constructor(private readonly bridge: Bridge) {
    this.chosen = recall<Limits>(`limits:${bridge.name}`, USUAL)
    this.drive = new Drive(
      (command) => this.send(command),
      () => this.obstacle(),
      () => this.limits,
      (phase, reason) => this.driveChanged(phase === 'driving', reason),
    )
  }

  // Driving

  grab(source: Source): boolean {
    this.words = null
    const reason = this.drive.grab(source, performance.now())
    if (reason !== null) this.words = this.blocked ?? stopWords(reason)
    else if (!this.isStopping) this.stopState = null
    return reason === null
  }

  steer(source: Source, turn: number, ahead: number): void {
    this.drive.steer(source, turn, ahead, performance.now())
  }

  release(source: Source): void {
    this.drive.release(source)
  }

  /** An input failed while it was held. */
  lose(source: Source, reason: StopReason): void {
    this.drive.lose(source, reason)
  }

  endDriving(reason: StopReason): void {
    this.drive.stop(reason)
  }

  tick(nowMs: number): void {
    this.drive.tick(nowMs)
  }

  setLimits(limits: Limits): void {
    this.chosen = limits
    remember(`limits:${this.bridge.name}`, limits)
  }

  private send(command: Twist): boolean {
    const topic = this.bridge.motion
    // Without control not even a zero is sent: if control is free, the command would take it. The robot itself stops when
    // its controller loses control (SPEC 2.5).
    if (topic === null || !this.isMine) return false
    const stamped = fullType(topic.type) === 'geometry_msgs/msg/TwistStamped'
    const header = { stamp: { sec: 0, nanosec: 0 }, frame_id: '' }
    return this.bridge.link.publish(topic.name, topic.type, stamped ? { header, twist: command } : command)
  }

  private obstacle(): StopReason | null {
    if (!this.bridge.link.isOpen) return 'link_closed'
    if (this.bridge.isLate()) return 'link_late'
    // The robot's watchdog has stopped it by then. Only a new press may move it afterwards.
    if (this.bridge.isRobotLate()) return 'robot_late'
    return this.blocked === null ? null : 'not_allowed'
  }

  private whyNotMine(): string | null {
    if (this.control === null) return 'Waiting for the state of control.'
    if (this.stopped !== null) return 'The robot is stopped. It does not move until it is resumed.'
    if (this.isMine) return null
    return this.state === 'free' ? 'Take control to drive.' : `${this.sentence} Only the holder of control can drive.`
  }

  private driveChanged(driving: boolean, reason: StopReason | null): void {
    this.driving = driving
    if (reason === null) return
    if (reason !== 'control_lost') this.words = reason === 'not_allowed' ? this.blocked : stopWords(reason)
    if (reason !== 'released') this.releaseCount += 1
  }

  // Control

  /** Takes the state of control from the relay. */
  receive(state: Control): void {
    const before = this.control
    this.control = state
    if (state.stopped !== null) this.drive.stop('robot_stopped')
    else if (this.driving && this.blocked !== null && this.isMine) this.drive.stop('not_allowed')
    // The message about the stop of this page is outdated after any resume.
    if (before?.stopped && state.stopped === null) this.words = null
    if (state.stopped === null) this.mayMove(before)
    else if (state.stopped.confirmed) this.stopConfirmed()
    if (control.isYours(before) && !this.isMine) this.lost()
    else if (this.reportedLoss !== null && this.words === this.reportedLoss) this.reportLoss(state)
    if (this.isMine !== control.isYours(before) || state.request?.you) this.answer = null
  }

  /** The link is lost, and control with it. */
  gone(): void {
    this.drive.stop('link_closed')
    this.control = null
    this.answer = null
  }

  /** The robot is not stopped, or was resumed; an earlier state may be older than a stop of this page. */
  private mayMove(before: Control | null): void {
    const resumed = before !== null && before.stopped !== null
    const meanwhile = before === null && this.stopState !== 'unsure'
    if ((resumed || meanwhile) && !this.isStopping) this.stopState = null
  }

  /** The robot has confirmed that it is stopped. */
  private stopConfirmed(): void {
    app.settle([this.bridge.name])
    if (this.stopState === 'later' || this.stopState === 'unsure') this.stopState = 'done'
  }

  private lost(): void {
    this.drive.stop('control_lost')
    this.releaseCount += 1
    if (!this.givingAway && this.control !== null) this.reportLoss(this.control)
    this.givingAway = false
  }

  /** Between two holders control is free for a moment, so the message about the loss follows the current state. */
  private reportLoss(after: Control): void {
    this.words = this.reportedLoss = control.isYours(after) ? null : control.whyLost(after, this.bridge.offline)
  }

  takeControl(why = ''): Promise<void> {
    this.words = null
    return this.order('take_control', why)
  }

  /** Releases control, or withdraws a request. */
  releaseControl(): Promise<void> {
    if (this.isMine) this.handOver()
    return this.order('release_control')
  }

  /** @param client the connection whose request was shown; another one may have requested control since */
  grant(client: number): Promise<void> {
    this.handOver()
    return this.order('grant_control', '', client)
  }

  private handOver(): void {
    this.drive.stop('released')
    this.releaseCount += 1
    this.givingAway = true
  }

  refuse(client: number): Promise<void> {
    return this.order('refuse_control', '', client)
  }

  private async order(order: Order, why = '', client?: number): Promise<void> {
    this.busy = order
    this.answer = null
    try {
      const args = client === undefined ? { why } : { why, client }
      await this.call<ControlReply>(`/relay/${order}`, client === undefined ? ORDER : REPLY, args)
    } catch (error) {
      this.givingAway = false
      // A pending request is reported by `/relay/control`; it is not an error.
      if (this.control?.request?.you !== true) this.answer = words(error)
    } finally {
      this.busy = null
    }
  }

  private async call<A extends ControlReply>(service: string, type: string, args: object, timeoutS?: number): Promise<A> {
    const answer = await this.bridge.link.call<object, A>(service, type, args, timeoutS)
    if (!answer.success) throw new NotDone(answer.message, 'stopped' in answer && answer.stopped !== null)
    return answer
  }

  // Stop

  /** Stops the robot for all users, by all paths at the same time, as one stop. */
  async stop(): Promise<void> {
    this.drive.stop('stop_button')
    this.releaseCount += 1
    this.stopState = 'going'
    const press = ++this.presses
    const timer = setTimeout(() => {
      if (press === this.presses && this.stopState === 'going') this.stopState = 'unanswered'
    }, UNANSWERED_MS)
    try {
      const id = control.newStopId()
      const asked = this.call<ControlReply & { done: boolean; stopped: Stopped | null }>('/relay/stop', STOP, { why: '', stop_id: id }, SWITCH_S)
      const later = await stopByAllPaths(this.bridge.name, id, [asked.then(({ done }) => !done)], inWords)
      app.settle([this.bridge.name])
      this.stopState = later ? 'later' : 'done'
    } catch (error) {
      // After repeated presses the last one counts.
      if (press === this.presses && this.isStopping) this.notConfirmed(error)
    } finally {
      clearTimeout(timer)
    }
  }

  private notConfirmed(error: unknown): void {
    // Failures of the robot are shown, although it is stopped.
    const inPart = error instanceof NotDone ? error.stopped : error instanceof Refusal && error.byRobot
    const known = this.stopped?.confirmed === true && this.bridge.link.isOpen && !this.bridge.isLate()
    this.stopState = inPart || known ? 'done' : 'unsure'
    if (inPart) app.notify('error', sentence(words(error)))
    else if (!known) app.notify('error', `The stop is not confirmed. ${words(error)}`, null, [this.bridge.name])
  }

  async resume(): Promise<void> {
    this.busy = 'resume'
    try {
      // By the websocket only, since it reports stops: without it the latest stop would be unknown.
      await this.call<ControlReply>('/relay/resume', ORDER, { why: '' }, SWITCH_S)
      this.words = null
      this.stopState = null
    } catch (error) {
      app.notify('error', `The robot stays stopped. ${words(error)}`)
    } finally {
      this.busy = null
    }
  }
}

/** Longest time of a stop or a resume, seconds: the relay waits 14 s for the robot, which may operate a hardware switch. */
const SWITCH_S = 16

/** The relay accepted an order, but did not carry out all of it. */
class NotDone extends Error {
  constructor(
    message: string,
    /** Whether the robot is stopped all the same. */
    readonly stopped: boolean,
  ) {
    super(message)
  }
}

/** Whether an error is more specific than a missing answer. */
function inWords(error: unknown): boolean {
  return error instanceof NotDone || error instanceof Refusal
}

function words(error: unknown): string {
  return error instanceof Error ? error.message : String(error)
}
