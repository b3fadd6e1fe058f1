/** Shapes of what the relay and the robots send. Times are named with their unit. */

export interface Session {
  user: string
  admin: boolean
  realm: string
}

export type RobotState = 'online' | 'offline' | 'in_use'
export type Level = 'viewer' | 'operator' | 'owner'

export interface Client {
  user: string
  /** Unix seconds. */
  since: number
}

export interface Robot {
  name: string
  description: string
  state: RobotState
  level: Level
  clients: Client[]
  /** 0 to 1. */
  battery: number | null
  rtt_ms: number | null
  host: string
  platform: string
  distro: string
  /** Unix seconds. */
  last_seen: number | null
}

export interface RelayStatus {
  robot: string
  state: RobotState
  level: Level
  clients: Client[]
  rtt_ms: { relay_robot: number | null }
  drops: number
  motion?: { topics: string[]; types: string[]; deadline_ms: number; stop_within_ms: number }
  health?: Partial<Health>
}

export interface Health {
  battery: number | null
  cpu: number | null
  memory: number | null
  rtt_ms: number | null
  stale_commands: number
  watchdog_stops: number
  dropped_samples: number
}

export interface TopicInfo {
  name: string
  type: string
}

export interface Vector3 {
  x: number
  y: number
  z: number
}

export interface Twist {
  linear: Vector3
  angular: Vector3
}

export interface Odometry {
  pose: { pose: { position: Vector3; orientation: Vector3 & { w: number } } }
  twist: { twist: Twist }
}

export interface LaserScan {
  angle_min: number
  angle_increment: number
  range_min: number
  range_max: number
  /** Metres; null where the robot measured nothing (JSON has no infinity). */
  ranges: (number | null)[]
}
