/** Round trips of one link, measured all the time: to the relay, from there to the robot, and all the way. */
import { type Legs, Median, PING_DRIVING_MS, PING_IDLE_MS, PingTracker, RelayClock, Silence } from './latency'
import { Gate } from './meter'
import type { Link } from './ros'

/** A link without an answer for so long is dialled anew. */
const SILENT_MS = 6000
/** Longer than the silence above, so that a silent link is seen as one. Seconds. */
const PING_TIMEOUT_S = 10

interface Pong {
  relay_time_ns: number
  robot_rtt_ms: number | null
}

export class Latency {
  legs = $state<Legs>({ clientRelay: null, relayRobot: null, clientRobot: null })
  /** A ping has been out for too long to drive by. */
  late = $state(false)
  /** The relay answers and the robot does not. */
  robotLate = $state(false)
  /** When the relay answered last, by the page's clock. */
  answeredMs = $state<number | null>(null)
  readonly clock = new RelayClock()

  private readonly pings = new PingTracker()
  private readonly robotTrips = new Median()
  private readonly idleGate = new Gate(PING_IDLE_MS)
  private readonly drivingGate = new Gate(PING_DRIVING_MS)
  private readonly robotIdleGate = new Gate(PING_IDLE_MS)
  private readonly robotDrivingGate = new Gate(PING_DRIVING_MS)
  private readonly robotSilence = new Silence()
  private robotPingOut = false

  constructor(private readonly link: Link) {}

  isLate(nowMs: number): boolean {
    return this.pings.isLate(nowMs)
  }

  /** Whether the robot has left a ping unanswered for too long to be driven. */
  isRobotLate(nowMs: number): boolean {
    return this.robotSilence.isLate(nowMs)
  }

  /** What the relay told of the way from it to the robot. */
  told(relayRobot: number | null, offline: boolean): void {
    if (offline) this.legs.clientRobot = null
    if (offline) this.robotSilence.over()
    this.legs.relayRobot = offline ? null : (relayRobot ?? this.legs.relayRobot)
  }

  /** Finds out whether the link or the robot is late; without sending anything. */
  look(nowMs: number): void {
    this.late = this.link.isOpen && this.pings.isLate(nowMs)
    this.robotLate = this.link.isOpen && this.robotSilence.isLate(nowMs)
  }

  /** Pings, when it is time to. */
  tick(nowMs: number, driving: boolean, robotThere: boolean): void {
    if ((driving ? this.drivingGate : this.idleGate).open(nowMs)) void this.pingRelay(nowMs)
    const robotGate = driving ? this.robotDrivingGate : this.robotIdleGate
    if (!this.robotPingOut && robotThere && robotGate.open(nowMs)) void this.pingRobot(nowMs)
    if (this.pings.silentFor(nowMs) > SILENT_MS) this.link.abandon()
  }

  /** Forgets what is under way. */
  reset(): void {
    this.pings.reset()
    this.clock.reset()
    this.robotSilence.over()
    this.late = this.robotLate = false
  }

  gone(): void {
    this.reset()
    this.robotPingOut = false
  }

  private async pingRelay(nowMs: number): Promise<void> {
    const number = this.pings.sent(nowMs)
    try {
      const answer = await this.ping(false)
      this.pings.answered(number, performance.now())
      this.clock.told(nowMs, performance.now(), answer.relay_time_ns / 1e6)
      this.answeredMs = performance.now()
      this.legs.clientRelay = this.pings.rtt
    } catch {
      this.pings.dropped(number)
    }
  }

  private async pingRobot(nowMs: number): Promise<void> {
    this.robotPingOut = true
    this.robotSilence.sent(nowMs)
    try {
      const answer = await this.ping(true)
      this.robotSilence.over()
      this.legs.clientRobot = this.robotTrips.add(performance.now() - nowMs)
      this.legs.relayRobot = answer.robot_rtt_ms
    } catch {
      this.robotTrips.reset()
      this.legs.clientRobot = null
    } finally {
      this.robotPingOut = false
    }
  }

  private ping(robot: boolean): Promise<Pong> {
    return this.link.call('/relay/ping', 'switchboard_msgs/srv/Ping', { robot }, PING_TIMEOUT_S)
  }
}
