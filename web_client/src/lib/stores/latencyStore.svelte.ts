/** Round trips of one link, measured continuously: page to relay, relay to robot, page to robot. */
import { type RoundTrips, Median, PING_DRIVING_MS, PING_IDLE_MS, PingTracker, RelayClock, Silence } from '../ros/latency'
import type { Pong } from '../ros/messages'
import { Gate } from '../ros/rateMeter'
import type { Link } from '../ros/robotLink'

/** Time without an answer after which the link is dialled again. */
const SILENT_MS = 6000
/** Timeout of pings, seconds. It is longer than the time above, so that a silent link is noticed as such. */
const PING_TIMEOUT_S = 10

export class Latency {
  legs = $state<RoundTrips>({ clientRelay: null, relayRobot: null, clientRobot: null })
  /** A ping has been unanswered for too long to drive. */
  late = $state(false)
  /** The relay answers, but the robot does not. */
  robotLate = $state(false)
  /** Time of the relay's last answer, by the page's clock. */
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

  /** The relay's round trip to the robot. */
  update(relayRobot: number | null, offline: boolean): void {
    if (offline) this.legs.clientRobot = null
    if (offline) this.robotSilence.over()
    this.legs.relayRobot = offline ? null : (relayRobot ?? this.legs.relayRobot)
  }

  /** Updates whether the link or the robot is late, without sending anything. */
  checkLateness(nowMs: number): void {
    this.late = this.link.isOpen && this.pings.isLate(nowMs)
    this.robotLate = this.link.isOpen && this.robotSilence.isLate(nowMs)
  }

  /** Sends pings that are due. */
  tick(nowMs: number, driving: boolean, robotThere: boolean): void {
    if ((driving ? this.drivingGate : this.idleGate).open(nowMs)) void this.pingRelay(nowMs)
    const robotGate = driving ? this.robotDrivingGate : this.robotIdleGate
    if (!this.robotPingOut && robotThere && robotGate.open(nowMs)) void this.pingRobot(nowMs)
    if (this.pings.silentFor(nowMs) > SILENT_MS) this.link.abandon()
  }

  /** Discards pending pings. */
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
      this.clock.update(nowMs, performance.now(), answer.relay_time_ns / 1e6)
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
