/** The state of the cockpit: link, rights, chosen topics, and what there is to see. One instance per open cockpit. */
import { cameras as fetchCameras, robot as fetchRobot, robotSocket } from './api'
import { app } from './app.svelte'
import type { Ending } from './closing'
import type { Control } from './control'
import { type Bridge, Helm } from './helm.svelte'
import { PING_IDLE_MS } from './latency'
import { Latency } from './latency.svelte'
import { Gate, isStale } from './meter'
import { Link, type LinkState } from './ros'
import { recall, remember } from './storage'
import { MOTION, ODOMETRY, ofType, pick, SCAN } from './topics'
import type { RelayStatus, Robot, TopicInfo } from './types'
import type { Camera } from './video'

const TICK_MS = 33
const TOPICS_MS = 5000
const CAMERAS_MS = 5000
/** The relay tells its status once a second. */
const STATUS_STALE_MS = 3000
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

export class Cockpit implements Bridge {
  linkState = $state<LinkState>('connecting')
  ending = $state<Ending | null>(null)
  robot = $state.raw<Robot | null>(null)
  status = $state.raw<RelayStatus | null>(null)
  topics = $state.raw<TopicInfo[]>([])
  topicsKnown = $state(false)
  /** Those the user may view; null before the relay told them. */
  cameras = $state.raw<Camera[] | null>(null)
  /** The page's clock in milliseconds, a few times a second, for marks of staleness. */
  nowMs = $state(performance.now())
  visible = $state(!document.hidden)

  private chosen = $state<Choice>({ scan: null, odometry: null, motion: null })
  private statusMs = $state<number | null>(null)
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
  readonly latencyStale = $derived.by(
    () => this.linkState !== 'open' || isStale(this.latency.answeredMs, this.nowMs, 2 * PING_IDLE_MS),
  )
  /** What the relay told of robot and people is too old to count as how it is now. */
  readonly statusStale = $derived(this.linkState !== 'open' || isStale(this.statusMs, this.nowMs, STATUS_STALE_MS))
  /** Why nobody could drive from here, whoever has control; null when one could. */
  readonly why = $derived(this.whyNot())
  readonly unixS = $derived.by(() => (this.latency.clock.unixMs(this.nowMs) ?? Date.now()) / 1000)

  readonly link: Link
  readonly helm: Helm
  readonly latency: Latency
  private readonly topicsGate = new Gate(TOPICS_MS)
  private readonly camerasGate = new Gate(CAMERAS_MS)
  private readonly nowGate = new Gate(200)
  private timer: ReturnType<typeof setInterval> | undefined

  constructor(readonly name: string) {
    this.chosen = recall<Choice>(`topics:${name}`, { scan: null, odometry: null, motion: null })
    this.link = new Link(robotSocket(name, location), {
      state: (state, why) => this.linkChanged(state, why),
      told: ({ level, words }) => app.tell(level === 'error' ? 'error' : 'info', words),
    })
    this.link.subscribe<RelayStatus>('/relay/status', 'switchboard_msgs/msg/Status', (status) => this.take(status))
    this.link.subscribe<Control>('/relay/control', 'switchboard_msgs/msg/Control', (told) => this.helm.take(told))
    this.latency = new Latency(this.link)
    this.helm = new Helm(this)
  }

  start(): void {
    this.link.connect()
    void this.fetchRobot()
    this.timer = setInterval(() => this.tick(), TICK_MS)
  }

  close(): void {
    clearInterval(this.timer)
    this.helm.halt('link_closed')
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

  topicFor(role: Role, topics = this.topics): TopicInfo | null {
    return pick(ofType(topics, TYPES[role]), USUAL[role], this.chosen[role])
  }

  choose(role: Role, name: string): void {
    if (role === 'motion') this.helm.halt('topic_changed')
    this.chosen = { ...this.chosen, [role]: name }
    remember(`topics:${this.name}`, this.chosen)
    if (role === 'motion') this.advertise()
  }

  setVisible(visible: boolean): void {
    this.visible = visible
    // Timers slept: what was out then says nothing about the link now.
    if (visible) this.latency.reset()
  }

  isLate(): boolean {
    return this.latency.isLate(performance.now()) || this.link.isStalled
  }

  isRobotLate(): boolean {
    return this.latency.isRobotLate(performance.now())
  }

  private whyNot(): string | null {
    if (this.linkState === 'ended') return this.ending?.words ?? 'The connection is closed.'
    if (this.robotState === 'offline') return 'The robot is offline.'
    if (this.level === 'viewer' && !this.helm.mayControl) {
      return 'You watch as a viewer. To drive you need the level operator; whoever runs this relay can give it to you.'
    }
    if (this.linkState !== 'open' || this.level === null) return 'Waiting for the connection.'
    if (!this.helm.mayControl) return 'You have no right to control this robot.'
    if (this.motion === null) {
      return this.topicsKnown ? 'This robot listens to no Twist topic.' : 'Waiting for the list of topics.'
    }
    return null
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
    // A refused handshake tells the page nothing; it may be about a session that is over, or another user's by now.
    if (state === 'waiting') app.checkSession()
    if (state === 'ended' && why?.after === 'login') app.toLogin(why.words)
  }

  private linkGone(): void {
    this.helm.gone()
    this.latency.gone()
  }

  private take(status: RelayStatus): void {
    this.status = status
    this.statusMs = performance.now()
    this.latency.told(status.state === 'offline' ? null : status.rtt_ms.relay_robot, status.state === 'offline')
    if (this.helm.driving && this.helm.blocked !== null) this.helm.halt('not_allowed')
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
      if (JSON.stringify(found) !== JSON.stringify(this.topics)) this.takeTopics(found)
      this.topicsKnown = true
      this.advertise()
    } catch {
      // Asked again in a moment; a lost link is shown elsewhere.
    }
  }

  private takeTopics(found: TopicInfo[]): void {
    const [before, next] = [this.motion, this.topicFor('motion', found)]
    // The zero belongs to the topic that was driven, so it goes out while that is still the one.
    if (before?.name !== next?.name || before?.type !== next?.type) this.helm.halt('topic_changed')
    this.topics = found
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
    this.helm.tick(now)
    if (this.nowGate.open(now)) this.nowMs = now
    this.latency.look(now)
    if (this.linkState !== 'open' || !this.visible) return
    this.latency.tick(now, this.helm.driving, !this.offline)
    if (this.topicsGate.open(now)) void this.fetchTopics()
    if (this.camerasGate.open(now)) void this.fetchCameras()
  }
}
