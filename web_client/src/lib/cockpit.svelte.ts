/** The state of the cockpit: link, latency, rights, chosen topics, driving. One instance per open cockpit. */
import { cameras as fetchCameras, currentSession, robot as fetchRobot, robotSocket } from './api'
import { app } from './app.svelte'
import type { Ending } from './closing'
import { Drive, type Limits, type Source, stopWords, type StopReason } from './drive'
import { type Legs, Median, PING_DRIVING_MS, PING_IDLE_MS, PingTracker, RelayClock } from './latency'
import { Gate } from './meter'
import { Link, type LinkState } from './ros'
import { recall, remember } from './storage'
import { fullType, MOTION, ODOMETRY, ofType, pick, SCAN } from './topics'
import type { RelayStatus, Robot, TopicInfo, Twist } from './types'
import type { Camera } from './video'

const TICK_MS = 33
const ROBOT_PING_MS = 1000
const TOPICS_MS = 5000
const CAMERAS_MS = 5000
/** A link without an answer for so long is dialled anew. */
const SILENT_MS = 6000
/** Longer than the silence above, so that a silent link is seen as one. Seconds. */
const PING_TIMEOUT_S = 10
/** A loss shorter than this is not spoken of. */
const LOSS_SHOWN_MS = 1000

export type Role = 'scan' | 'odometry' | 'motion'
type Choice = Record<Role, string | null>

const TYPES: Record<Role, string[]> = { scan: SCAN, odometry: ODOMETRY, motion: MOTION }
const USUAL: Record<Role, string[]> = {
  scan: ['scan'],
  odometry: ['odom'],
  motion: ['cmd_vel'],
}

export class Cockpit {
  linkState = $state<LinkState>('connecting')
  ending = $state<Ending | null>(null)
  robot = $state.raw<Robot | null>(null)
  status = $state.raw<RelayStatus | null>(null)
  topics = $state.raw<TopicInfo[]>([])
  topicsKnown = $state(false)
  /** Those the user may view; null before the relay told them. */
  cameras = $state.raw<Camera[] | null>(null)
  legs = $state<Legs>({ clientRelay: null, relayRobot: null, clientRobot: null })
  late = $state(false)
  driving = $state(false)
  /** Why driving ended the last time, in words. */
  stopped = $state<string | null>(null)
  /** Changes when the joystick must let go of the hand that holds it. */
  letGo = $state(0)
  limits = $state<Limits>({ linear: 0.5, angular: 1 })
  /** The page's clock in milliseconds, a few times a second, for marks of staleness. */
  nowMs = $state(performance.now())
  visible = $state(!document.hidden)

  private chosen = $state<Choice>({ scan: null, odometry: null, motion: null })
  private answeredMs = $state<number | null>(null)
  private lostMs = $state<number | null>(null)

  readonly level = $derived(this.status?.level ?? this.robot?.level ?? null)
  readonly robotState = $derived(this.status?.state ?? this.robot?.state ?? null)
  readonly clients = $derived(this.status?.clients ?? this.robot?.clients ?? [])
  readonly offline = $derived(this.robotState === 'offline')
  /** How the robot said it is; nothing while it is away, for that would be how it was. */
  readonly health = $derived(this.offline ? null : (this.status?.health ?? null))
  readonly battery = $derived(this.offline ? null : (this.health?.battery ?? this.robot?.battery ?? null))
  readonly motion = $derived(this.topicFor('motion'))
  readonly lost = $derived(this.lostMs !== null && this.nowMs - this.lostMs > LOSS_SHOWN_MS)
  readonly latencyStale = $derived(
    this.linkState !== 'open' || this.answeredMs === null || this.nowMs - this.answeredMs > 2 * PING_IDLE_MS,
  )
  /** Why the controls are disabled, or null. */
  readonly blocked = $derived(this.whyBlocked())

  readonly link: Link
  readonly relayClock = new RelayClock()
  private readonly drive: Drive
  private readonly pings = new PingTracker()
  private readonly robotGate = new Gate(ROBOT_PING_MS)
  private readonly topicsGate = new Gate(TOPICS_MS)
  private readonly camerasGate = new Gate(CAMERAS_MS)
  private readonly nowGate = new Gate(200)
  private readonly idleGate = new Gate(PING_IDLE_MS)
  private readonly drivingGate = new Gate(PING_DRIVING_MS)
  private readonly robotTrips = new Median()
  private robotPingOut = false
  private timer: ReturnType<typeof setInterval> | undefined

  constructor(readonly name: string) {
    this.chosen = recall<Choice>(`topics:${name}`, { scan: null, odometry: null, motion: null })
    this.limits = recall<Limits>(`limits:${name}`, { linear: 0.5, angular: 1 })
    this.drive = new Drive(
      (command) => this.send(command),
      () => this.obstacle(),
      this.limits,
      (phase, reason) => this.driveChanged(phase === 'driving', reason),
    )
    this.link = new Link(robotSocket(name, location), {
      state: (state, why) => this.linkChanged(state, why),
      told: ({ level, words }) => app.tell(level === 'error' ? 'error' : 'info', words),
    })
    this.link.subscribe<RelayStatus>('/relay/status', 'switchboard_msgs/msg/Status', (status) => this.take(status))
  }

  start(): void {
    this.link.connect()
    void this.fetchRobot()
    this.timer = setInterval(() => this.tick(), TICK_MS)
  }

  close(): void {
    clearInterval(this.timer)
    this.drive.stop('link_closed')
    this.link.close()
  }

  // Choosing topics

  candidates(role: Role): TopicInfo[] {
    return ofType(this.topics, TYPES[role])
  }

  /** Why a panel has no topic to show. */
  missing(what: string): string {
    if (this.offline) return 'The robot is offline.'
    return this.topicsKnown ? `This robot publishes no ${what}.` : 'Waiting for the list of topics.'
  }

  topicFor(role: Role): TopicInfo | null {
    return pick(this.candidates(role), USUAL[role], this.chosen[role])
  }

  choose(role: Role, name: string): void {
    if (role === 'motion') this.drive.stop('topic_changed')
    this.chosen = { ...this.chosen, [role]: name }
    remember(`topics:${this.name}`, this.chosen)
    if (role === 'motion') this.advertise()
  }

  // Driving

  grab(source: Source): boolean {
    this.stopped = null
    const reason = this.drive.grab(source, performance.now())
    if (reason !== null) this.stopped = this.blocked ?? stopWords(reason)
    return reason === null
  }

  steer(source: Source, turn: number, ahead: number): void {
    this.drive.steer(source, turn, ahead, performance.now())
  }

  release(source: Source): void {
    this.drive.release(source)
  }

  stop(reason: StopReason): void {
    this.drive.stop(reason)
  }

  pressStop(): void {
    this.letGo += 1
    if (this.drive.stopNow()) this.stopped = 'Stop was sent.'
    else app.tell('error', this.blocked ?? 'The stop could not be sent: there is no connection.')
  }

  setLimits(limits: Limits): void {
    this.limits = limits
    this.drive.setLimits(limits)
    remember(`limits:${this.name}`, limits)
  }

  setVisible(visible: boolean): void {
    this.visible = visible
    if (visible) {
      // Timers slept: what was out then says nothing about the link now.
      this.pings.reset()
      this.relayClock.reset()
      this.late = false
    } else {
      this.drive.stop('page_hidden')
    }
  }

  private send(command: Twist): boolean {
    const topic = this.motion
    if (topic === null || this.level === 'viewer') return false
    const stamped = fullType(topic.type) === 'geometry_msgs/msg/TwistStamped'
    const header = { stamp: { sec: 0, nanosec: 0 }, frame_id: '' }
    return this.link.publish(topic.name, topic.type, stamped ? { header, twist: command } : command)
  }

  private obstacle(): StopReason | null {
    if (!this.link.isOpen) return 'link_closed'
    if (this.pings.isLate(performance.now()) || this.link.isStalled) return 'link_late'
    return this.blocked === null ? null : 'not_allowed'
  }

  private whyBlocked(): string | null {
    if (this.linkState === 'ended') return this.ending?.words ?? 'The connection is closed.'
    if (this.robotState === 'offline') return 'The robot is offline.'
    if (this.level === 'viewer') {
      return 'You watch as a viewer. To drive you need the level operator; whoever runs this relay can give it to you.'
    }
    if (this.linkState !== 'open' || this.level === null) return 'Waiting for the connection.'
    if (this.motion === null) {
      return this.topicsKnown ? 'This robot listens to no Twist topic.' : 'Waiting for the list of topics.'
    }
    return null
  }

  private driveChanged(driving: boolean, reason: StopReason | null): void {
    this.driving = driving
    if (reason === null) return
    this.stopped = reason === 'not_allowed' ? this.blocked : stopWords(reason)
    if (reason !== 'released') this.letGo += 1
  }

  private advertise(): void {
    if (this.motion !== null && this.level !== null && this.level !== 'viewer') {
      this.link.advertise(this.motion.name, this.motion.type)
    }
  }

  // What arrives

  private linkChanged(state: LinkState, why: Ending | null): void {
    this.linkState = state
    if (why !== null) this.ending = why
    if (state === 'open') this.ending = null
    if (state === 'open') this.lostMs = null
    else this.lostMs ??= performance.now()
    if (state === 'open') void this.fetchTopics()
    if (state === 'waiting' || state === 'ended') this.linkGone()
    if (state === 'waiting') void this.checkSession()
    if (state === 'ended' && why?.after === 'login') app.toLogin(why.words)
  }

  /** A refused websocket handshake tells the page nothing, so it asks whether it is still logged in. */
  private async checkSession(): Promise<void> {
    try {
      if ((await currentSession()) === null) app.toLogin('Your session has ended. Please log in again.')
    } catch {
      // The relay is away; the link goes on trying.
    }
  }

  private linkGone(): void {
    this.drive.stop('link_closed')
    this.pings.reset()
    this.relayClock.reset()
    this.robotPingOut = false
    this.late = false
  }

  private take(status: RelayStatus): void {
    this.status = status
    if (status.state === 'offline') {
      this.legs.relayRobot = null
      this.legs.clientRobot = null
    } else {
      this.legs.relayRobot = status.rtt_ms?.relay_robot ?? this.legs.relayRobot
    }
    if (this.driving && this.blocked !== null) this.drive.stop('not_allowed')
  }

  private async fetchRobot(): Promise<void> {
    try {
      this.robot = await fetchRobot(this.name)
    } catch {
      // The websocket says the same in its close code, and goes on trying.
    }
  }

  private async fetchTopics(): Promise<void> {
    try {
      const answer = await this.link.call<object, { topics: string[]; types: string[] }>(
        '/rosapi/topics',
        'rosapi_msgs/srv/Topics',
        {},
      )
      const found = answer.topics.map((name, i) => ({ name, type: answer.types[i] ?? '' }))
      found.sort((a, b) => a.name.localeCompare(b.name))
      // A robot that has just gone has no topics; what it had is what the panels wait for.
      if (this.topics.length > 0 && found.every((topic) => topic.name.startsWith('/relay/'))) return
      // The same list anew would restart every subscription that depends on it.
      if (JSON.stringify(found) !== JSON.stringify(this.topics)) this.topics = found
      this.topicsKnown = true
      this.advertise()
    } catch {
      // Asked again in a moment; a lost link is shown elsewhere.
    }
  }

  private async fetchCameras(): Promise<void> {
    try {
      const found = await fetchCameras(this.name)
      if (JSON.stringify(found) !== JSON.stringify(this.cameras)) this.cameras = found
    } catch {
      // Asked again in a moment; a lost link is shown elsewhere.
    }
  }

  // The clock

  private tick(): void {
    const now = performance.now()
    this.late = this.linkState === 'open' && this.pings.isLate(now)
    this.drive.tick(now)
    if (this.nowGate.open(now)) this.nowMs = now
    if (this.linkState !== 'open' || !this.visible) return
    if ((this.driving ? this.drivingGate : this.idleGate).open(now)) void this.pingRelay(now)
    if (!this.robotPingOut && this.robotState !== 'offline' && this.robotGate.open(now)) void this.pingRobot(now)
    if (this.topicsGate.open(now)) void this.fetchTopics()
    if (this.camerasGate.open(now)) void this.fetchCameras()
    if (this.pings.silentFor(now) > SILENT_MS) this.link.abandon()
  }

  private async pingRelay(now: number): Promise<void> {
    const number = this.pings.sent(now)
    try {
      const answer = await this.ping(false)
      this.pings.answered(number, performance.now())
      this.relayClock.told(now, performance.now(), answer.relay_time_ns / 1e6)
      this.answeredMs = performance.now()
      this.legs.clientRelay = this.pings.rtt
    } catch {
      this.pings.dropped(number)
    }
  }

  private async pingRobot(now: number): Promise<void> {
    this.robotPingOut = true
    try {
      const answer = await this.ping(true)
      this.legs.clientRobot = this.robotTrips.add(performance.now() - now)
      this.legs.relayRobot = answer.robot_rtt_ms
    } catch {
      this.robotTrips.reset()
      this.legs.clientRobot = null
    } finally {
      this.robotPingOut = false
    }
  }

  private ping(robot: boolean): Promise<{ relay_time_ns: number; robot_rtt_ms: number | null }> {
    return this.link.call('/relay/ping', 'switchboard_msgs/srv/Ping', { robot }, PING_TIMEOUT_S)
  }
}
