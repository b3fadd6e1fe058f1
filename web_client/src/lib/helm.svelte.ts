/** The page's hand on one robot: who has control, driving, stop and resume. */
import * as api from './api'
import { app } from './app.svelte'
import * as control from './control'
import { Drive, type Limits, type Source, type StopReason, stopWords } from './drive'
import type { Link } from './ros'
import { recall, remember } from './storage'
import { fullType } from './topics'
import type { Level, TopicInfo, Twist } from './types'

const ORDER = 'switchboard_msgs/srv/Order'
const REPLY = 'switchboard_msgs/srv/Reply'
const STOP = 'switchboard_msgs/srv/Stop'
const USUAL: Limits = { linear: 0.5, angular: 1 }

type Order = 'take_control' | 'release_control' | 'grant_control' | 'refuse_control' | 'resume'

interface Answer {
  success: boolean
  message: string
}

/** How far a stop that was given here has come; in words they win over all others. */
const ENDINGS = {
  going: 'Stopping…',
  done: 'The robot is stopped.',
  later: 'The robot is away. It is stopped as soon as it is back.',
  unsure: 'The stop is not confirmed. Press STOP again, or stop the robot where it is.',
} as const

/** What the helm asks of the cockpit around it. */
export interface Bridge {
  readonly name: string
  readonly link: Link
  readonly level: Level | null
  readonly offline: boolean
  readonly motion: TopicInfo | null
  /** Why nobody could drive from here, whoever has control; null when one could. */
  readonly why: string | null
  /** Unix time in seconds, by the relay's clock, as often as the page shows it. */
  readonly unixS: number
  isLate(): boolean
  /** The relay answers in time and the robot does not. */
  isRobotLate(): boolean
}

export class Helm {
  /** As the relay told it last; null before, and while there is no link. */
  control = $state.raw<control.Control | null>(null)
  driving = $state(false)
  /** Why driving ended the last time, in words. */
  words = $state<string | null>(null)
  /** What becomes of the last stop that was given here; null when that is over. */
  ending = $state<keyof typeof ENDINGS | null>(null)
  readonly stopWords = $derived(this.ending === null ? null : ENDINGS[this.ending])
  /** Changes when every input must let go of the hand that holds it. */
  letGo = $state(0)
  /** Whether the control that has the focus takes keys that would else drive or stop. */
  keysTaken = $state(false)
  chosen = $state<Limits>(USUAL)
  /** The order that is under way. */
  busy = $state<Order | null>(null)
  /** Why the relay did not do the last one, in its own words. */
  answer = $state<string | null>(null)

  readonly standing = $derived.by(() =>
    control.standing(this.control, app.session?.user ?? '', this.bridge.level, this.bridge.unixS),
  )
  readonly sentence = $derived.by(() => control.sentenceOf(this.control, this.standing, this.bridge.unixS))
  readonly isMine = $derived(control.isYours(this.control))
  readonly mayControl = $derived.by(() => this.control?.you.may_control ?? this.bridge.level !== 'viewer')
  readonly mayResume = $derived(this.control?.you.may_resume === true)
  readonly stopped = $derived(this.control?.stopped ?? null)
  /** Who commands the chosen topic though he has no control; null for nobody. */
  readonly suppressor = $derived.by(() => control.suppressor(this.control, this.bridge.motion?.name ?? null))
  /** What the robot allows this user at most. */
  readonly top = $derived.by(() => control.topOf(this.control, this.bridge.level))
  readonly limits = $derived(control.within(this.chosen, this.top))
  /** Why the controls are disabled, or null. */
  readonly blocked = $derived.by(() => this.bridge.why ?? this.whyNotMine())

  private readonly drive: Drive
  private givingAway = false
  private lossTold: string | null = null
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
    else if (this.ending !== 'going') this.ending = null
    return reason === null
  }

  steer(source: Source, turn: number, ahead: number): void {
    this.drive.steer(source, turn, ahead, performance.now())
  }

  release(source: Source): void {
    this.drive.release(source)
  }

  /** An input failed in the hand. */
  lose(source: Source, reason: StopReason): void {
    this.drive.lose(source, reason)
  }

  halt(reason: StopReason): void {
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
    // Without control not even a zero: where control is free, a command would take it. Whoever loses it, the robot
    // itself stops (protocol/SPEC.md 2.5).
    if (topic === null || !this.isMine) return false
    const stamped = fullType(topic.type) === 'geometry_msgs/msg/TwistStamped'
    const header = { stamp: { sec: 0, nanosec: 0 }, frame_id: '' }
    return this.bridge.link.publish(topic.name, topic.type, stamped ? { header, twist: command } : command)
  }

  private obstacle(): StopReason | null {
    if (!this.bridge.link.isOpen) return 'link_closed'
    if (this.bridge.isLate()) return 'link_late'
    // Its watchdog has stopped it by then: when it hears again nothing shall move it but a new grip.
    if (this.bridge.isRobotLate()) return 'robot_late'
    return this.blocked === null ? null : 'not_allowed'
  }

  private whyNotMine(): string | null {
    if (this.control === null) return 'Waiting to hear who has control.'
    if (this.stopped !== null) return 'The robot is stopped. Nothing moves it before somebody resumes it.'
    if (this.isMine) return null
    return this.standing === 'free' ? 'Take control to drive.' : `${this.sentence} Only who has control can drive.`
  }

  private driveChanged(driving: boolean, reason: StopReason | null): void {
    this.driving = driving
    if (reason === null) return
    if (reason !== 'control_lost') this.words = reason === 'not_allowed' ? this.blocked : stopWords(reason)
    if (reason !== 'released') this.letGo += 1
  }

  // Control

  /** The relay told who has control. */
  take(told: control.Control): void {
    const before = this.control
    this.control = told
    if (told.stopped !== null) this.drive.stop('robot_stopped')
    else if (this.driving && this.blocked !== null && this.isMine) this.drive.stop('not_allowed')
    // What was said when it was stopped here is over, whoever resumed it.
    if (before?.stopped && told.stopped === null) this.words = null
    if (told.stopped === null) this.mayMove(before)
    else if (told.stopped.told) this.stands()
    if (control.isYours(before) && !this.isMine) this.lost()
    else if (this.lossTold !== null && this.words === this.lossTold) this.tellLoss(told)
    if (this.isMine !== control.isYours(before) || told.request?.you) this.answer = null
  }

  /** The link is gone, and control with it. */
  gone(): void {
    this.drive.stop('link_closed')
    this.control = null
    this.answer = null
  }

  /** It is not stopped, or was resumed; what was told of it before may be older than a stop that was given here. */
  private mayMove(before: control.Control | null): void {
    const resumed = before !== null && before.stopped !== null
    const meanwhile = before === null && this.ending !== 'unsure'
    if ((resumed || meanwhile) && this.ending !== 'going') this.ending = null
  }

  /** The robot has confirmed that it is stopped. */
  private stands(): void {
    app.settle([this.bridge.name])
    if (this.ending === 'later' || this.ending === 'unsure') this.ending = 'done'
  }

  private lost(): void {
    this.drive.stop('control_lost')
    this.letGo += 1
    if (!this.givingAway && this.control !== null) this.tellLoss(this.control)
    this.givingAway = false
  }

  /** Between two who have control the robot is free for a moment; what is told of the loss goes with the present. */
  private tellLoss(after: control.Control): void {
    this.words = this.lossTold = control.isYours(after) ? null : control.whyLost(after, this.bridge.offline)
  }

  takeControl(why = ''): Promise<void> {
    this.words = null
    return this.order('take_control', why)
  }

  /** Gives control back, or withdraws a request. */
  giveBack(): Promise<void> {
    if (this.isMine) this.handOver()
    return this.order('release_control')
  }

  /** @param client the connection that asked, as it was shown: another may have asked since */
  grant(client: number): Promise<void> {
    this.handOver()
    return this.order('grant_control', '', client)
  }

  private handOver(): void {
    this.drive.stop('released')
    this.letGo += 1
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
      await this.call<Answer>(`/relay/${order}`, client === undefined ? ORDER : REPLY, args)
    } catch (error) {
      this.givingAway = false
      // A request that was placed is told by `/relay/control`, before this or after; it is no failure.
      if (this.control?.request?.you !== true) this.answer = words(error)
    } finally {
      this.busy = null
    }
  }

  private async call<A extends Answer>(service: string, type: string, args: object, timeoutS?: number): Promise<A> {
    const answer = await this.bridge.link.call<object, A>(service, type, args, timeoutS)
    if (!answer.success) throw new NotDone(answer.message)
    return answer
  }

  // Stop

  /** Stops the robot for everybody: by the websocket and by HTTP at once, whichever comes first. */
  async stop(): Promise<void> {
    this.drive.stop('stop_button')
    this.letGo += 1
    this.ending = 'going'
    const press = ++this.presses
    try {
      const asked = this.call<Answer & { done: boolean }>('/relay/stop', STOP, { why: '' }, SWITCH_S)
      const ways = [asked.then(({ done }) => !done), api.stopRobot(this.bridge.name)]
      const later = await control.byAnyWay(ways, inWords)
      app.settle([this.bridge.name])
      this.ending = later ? 'later' : 'done'
    } catch (error) {
      // Of one that was pressed again the last press tells.
      if (press === this.presses && this.ending === 'going') this.notConfirmed(error)
    }
  }

  private notConfirmed(error: unknown): void {
    const byRobot = error instanceof NotDone || (error instanceof api.Refusal && error.byRobot)
    const known = this.stopped?.told === true && this.bridge.link.isOpen && !this.bridge.isLate()
    this.ending = known ? 'done' : 'unsure'
    // What the robot could not do is told, though it stands.
    if (byRobot || !known) app.tell('error', `The stop is not confirmed. ${words(error)}`, null, byRobot ? [] : [this.bridge.name])
  }

  async resume(): Promise<void> {
    this.busy = 'resume'
    try {
      // By the connection that tells of stops alone: whoever is cut off does not know of the latest.
      await this.call<Answer>('/relay/resume', ORDER, { why: '' }, SWITCH_S)
      this.words = null
      this.ending = null
    } catch (error) {
      app.tell('error', `The robot stays stopped. ${words(error)}`)
    } finally {
      this.busy = null
    }
  }
}

/** Seconds that a stop or a resume may take: the relay waits 14 for the robot, which may have switches to throw. */
const SWITCH_S = 16

/** The relay took an order and did not do it. */
class NotDone extends Error {}

/** Whether an error tells more than that nothing was heard. */
function inWords(error: unknown): boolean {
  return error instanceof NotDone || error instanceof api.Refusal
}

function words(error: unknown): string {
  return error instanceof Error ? error.message : String(error)
}
