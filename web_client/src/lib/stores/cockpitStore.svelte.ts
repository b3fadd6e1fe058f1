/** The state of the cockpit: link, rights, chosen topics, received data. One instance per open cockpit. */
import { cameras as fetchCameras, robot as fetchRobot, robotSocket } from '../api/api'
import { app } from './appStore.svelte.ts'
import type { Ending } from '../api/closeCodes'
import { type Bridge, ControlStore } from './controlStore.svelte.ts'
import { PING_IDLE_MS } from '../ros/latency'
import { Latency } from './latencyStore.svelte.ts'
import { Gate, isStale } from '../ros/rateMeter'
import { Link, type LinkState } from '../ros/robotLink'
import { recall, remember } from './storage'
import { GRID, isCostmap, MOTION, ODOMETRY, ofType, PATH, pick, SCAN } from '../ros/topics'
import type { Camera, Control, Robot } from '../api/types'
import type { RelayStatus, TopicInfo } from '../ros/messages'
import { relayTime } from '../relayClock'

const TICK_MS = 33
const TOPICS_MS = 5000
const CAMERAS_MS = 5000
/** The relay sends its status once a second. */
const STATUS_STALE_MS = 3000
/** A shorter loss is not shown, milliseconds. */
const LOSS_SHOWN_MS = 1000

export type Role = 'scan' | 'odometry' | 'motion' | 'map' | 'plan'
type Choice = Record<Role, string | null>

const TYPES: Record<Role, string[]> = { scan: SCAN, odometry: ODOMETRY, motion: MOTION, map: GRID, plan: PATH }
const USUAL: Record<Role, string[]> = {
  scan: ['scan'],
  odometry: ['odom'],
  motion: ['cmd_vel'],
  map: ['map'],
  plan: ['plan'],
}
const NOTHING_CHOSEN: Choice = { scan: null, odometry: null, motion: null, map: null, plan: null }

export class Cockpit implements Bridge {
  linkState = $state<LinkState>('connecting')
  ending = $state<Ending | null>(null)
  robot = $state.raw<Robot | null>(null)
  status = $state.raw<RelayStatus | null>(null)
  topics = $state.raw<TopicInfo[]>([])
  topicsKnown = $state(false)
  /** Cameras the user may view; null before the relay sent them. */
  cameras = $state.raw<Camera[] | null>(null)
  /** The page's clock in milliseconds, a few times a second, for marks of staleness. */
  nowMs = $state(performance.now())
  visible = $state(!document.hidden)

  private chosen = $state<Choice>(NOTHING_CHOSEN)
  private statusMs = $state<number | null>(null)
  private lostMs = $state<number | null>(null)

  readonly level = $derived(this.status?.level ?? this.robot?.level ?? null)
  readonly robotState = $derived(this.status?.state ?? this.robot?.state ?? null)
  readonly clients = $derived(this.status?.clients ?? this.robot?.clients ?? [])
  readonly offline = $derived(this.robotState === 'offline')
  /** The robot's last report; null while it is offline, since the report would be outdated. */
  readonly health = $derived(this.offline ? null : (this.status?.health ?? null))
  readonly battery = $derived(this.offline ? null : (this.health?.battery ?? this.robot?.battery ?? null))
  readonly motion = $derived(this.topicFor('motion'))
  readonly lost = $derived(this.lostMs !== null && this.nowMs - this.lostMs > LOSS_SHOWN_MS)
  readonly latencyStale = $derived.by(
    () => this.linkState !== 'open' || isStale(this.latency.answeredMs, this.nowMs, 2 * PING_IDLE_MS),
  )
  /** The last state of robot and users is outdated. */
  readonly statusStale = $derived(this.linkState !== 'open' || isStale(this.statusMs, this.nowMs, STATUS_STALE_MS))
  /** Why driving is not possible from this page, apart from control; null if it is. */
  readonly why = $derived(this.whyNot())
  readonly unixS = $derived.by(() => (this.latency.clock.unixMs(this.nowMs) ?? relayTime() * 1000) / 1000)

  readonly link: Link
  readonly controlStore: ControlStore
  readonly latency: Latency
  private readonly topicsGate = new Gate(TOPICS_MS)
  private readonly camerasGate = new Gate(CAMERAS_MS)
  private readonly nowGate = new Gate(200)
  private timer: ReturnType<typeof setInterval> | undefined

  constructor(readonly name: string) {
    this.chosen = recall<Choice>(`topics:${name}`, NOTHING_CHOSEN)
    this.link = new Link(robotSocket(name, location), {
      state: (state, why) => this.linkChanged(state, why),
      received: ({ level, words }) => app.notify(level === 'error' ? 'error' : 'info', words),
    })
    this.link.subscribe<RelayStatus>('/relay/status', 'switchboard_msgs/msg/Status', (status) => this.take(status))
    this.link.subscribe<Control>('/relay/control', 'switchboard_msgs/msg/Control', (state) => this.controlStore.receive(state))
    this.latency = new Latency(this.link)
    this.controlStore = new ControlStore(this)
  }

  start(): void {
    this.link.connect()
    void this.fetchRobot()
    this.timer = setInterval(() => this.tick(), TICK_MS)
  }

  close(): void {
    clearInterval(this.timer)
    this.controlStore.endDriving('link_closed')
    this.link.close()
  }

  // Choosing topics

  candidates(role: Role, topics = this.topics): TopicInfo[] {
    const found = ofType(topics, TYPES[role])
    return role === 'map' ? found.filter((topic) => !isCostmap(topic)) : found
  }

  /** Grids that may lie over the map. */
  get costmaps(): TopicInfo[] {
    return ofType(this.topics, GRID).filter(isCostmap)
  }

  /** Why a panel has no topic to show. */
  missing(what: string): string {
    if (this.offline) return 'The robot is offline.'
    return this.topicsKnown ? `This robot publishes no ${what}.` : 'Waiting for the list of topics.'
  }

  topicFor(role: Role, topics = this.topics): TopicInfo | null {
    return pick(this.candidates(role, topics), USUAL[role], this.chosen[role])
  }

  choose(role: Role, name: string): void {
    if (role === 'motion') this.controlStore.endDriving('topic_changed')
    this.chosen = { ...this.chosen, [role]: name }
    remember(`topics:${this.name}`, this.chosen)
    if (role === 'motion') this.advertise()
  }

  setVisible(visible: boolean): void {
    this.visible = visible
    // Timers were suspended, so pings from before say nothing about the present link.
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
    if (this.level === 'viewer' && !this.controlStore.mayControl) {
      return 'You are a viewer. Driving needs the level operator; ask an administrator.'
    }
    if (this.linkState !== 'open' || this.level === null) return 'Waiting for the connection.'
    if (!this.controlStore.mayControl) return 'You have no right to control this robot.'
    if (this.motion === null) {
      return this.topicsKnown ? 'This robot subscribes to no Twist topic.' : 'Waiting for the list of topics.'
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
    // A refused handshake gives no reason; the session may have ended, or belong to another user.
    if (state === 'waiting') app.checkSession()
    if (state === 'ended' && why?.after === 'login') app.toLogin(why.words)
  }

  private linkGone(): void {
    this.controlStore.gone()
    this.latency.gone()
  }

  private take(status: RelayStatus): void {
    this.status = status
    this.statusMs = performance.now()
    this.latency.update(status.state === 'offline' ? null : status.rtt_ms.relay_robot, status.state === 'offline')
    if (this.controlStore.driving && this.controlStore.blocked !== null) this.controlStore.endDriving('not_allowed')
  }

  private async fetchRobot(): Promise<void> {
    try {
      this.robot = await fetchRobot(this.name)
    } catch {
      // The websocket reports the same by its close code, and reconnects.
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
      // An offline robot reports no topics; the panels keep the earlier ones.
      if (this.topics.length > 0 && found.every((topic) => topic.name.startsWith('/relay/'))) return
      // Setting an equal list would restart every subscription that depends on it.
      if (JSON.stringify(found) !== JSON.stringify(this.topics)) this.takeTopics(found)
      this.topicsKnown = true
      this.advertise()
    } catch {
      // The request is repeated soon; a lost link is shown elsewhere.
    }
  }

  private takeTopics(found: TopicInfo[]): void {
    const [before, next] = [this.motion, this.topicFor('motion', found)]
    // The zero must go to the topic that was driven, so it is sent before the change.
    if (before?.name !== next?.name || before?.type !== next?.type) this.controlStore.endDriving('topic_changed')
    this.topics = found
  }

  private async fetchCameras(): Promise<void> {
    try {
      const found = await fetchCameras(this.name)
      if (JSON.stringify(found) !== JSON.stringify(this.cameras)) this.cameras = found
    } catch {
      // The request is repeated soon; a lost link is shown elsewhere.
    }
  }

  // The clock

  private tick(): void {
    const now = performance.now()
    this.controlStore.tick(now)
    if (this.nowGate.open(now)) this.nowMs = now
    this.latency.checkLateness(now)
    if (this.linkState !== 'open' || !this.visible) return
    this.latency.tick(now, this.controlStore.driving, !this.offline)
    if (this.topicsGate.open(now)) void this.fetchTopics()
    if (this.camerasGate.open(now)) void this.fetchCameras()
  }
}
