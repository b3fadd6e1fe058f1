/** Shapes of what the relay and the robots send. Times are named with their unit. */
import type { Stopped } from './control'

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
  /** What is watched; empty for who works with the robot. */
  camera: string
}

/** How good a link is, in a word: of the last seconds. */
export type Quality = 'good' | 'fair' | 'bad' | 'lost'

export interface LinkFacts {
  rtt_ms: number | null
  p95_ms: number | null
  jitter_ms: number | null
  lost: number | null
  quality: Quality | null
}

export interface Connection {
  client: number
  /** Unix seconds. */
  since: number
  you: boolean
  control: boolean
  rtt_ms: number | null
  quality: Quality | null
  drops: number
  /** Null for all but owners. */
  address: string | null
}

export interface Person {
  user: string
  you: boolean
  control: boolean
  connections: Connection[]
  watching: { camera: string; since: number }[]
}

/** A camera's stream as it is shown now. */
export interface Stream {
  camera: string
  codec: string
  viewers: number
  width?: number | null
  height?: number | null
  quality?: number | null
  fps?: number | null
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
  quality?: Quality | null
  /** Who has control. */
  holder?: string | null
  stopped?: Stopped | null
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
  links?: Partial<Record<'client_relay' | 'relay_robot' | 'client_robot', LinkFacts>>
  people?: Person[]
  /** Connections and cameras beside those that are told. */
  more?: number
  drops: number
  video?: Stream[]
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

export type RecordingState = 'recording' | 'finishing' | 'complete' | 'incomplete' | 'recovered'

export interface Recording {
  id: string
  user: string
  topics: string[]
  cameras: string[]
  /** Unix seconds. */
  begun: number
  /** Seconds it has taken; null while nobody knows. */
  lasted: number | null
  state: RecordingState
  reason: string
  /** It may take. */
  seconds: number
  /** The file may have. */
  megabytes: number
  /** Of the file. */
  bytes: number
  messages: number
  drops: number
  problems: string[]
}

/** What could be recorded of a robot now. */
export interface Possible {
  topics: string[]
  cameras: string[]
  /** Why it is nothing at all; may be empty. */
  denied: string
  /** What all recordings of the relay may have together. */
  megabytes: number
  /** How much of that is left. */
  left: number
  /** Why there can't be one more, however small; may be empty. */
  full: string
}

export interface RecordingAsk {
  topics: string[]
  cameras: string[]
  seconds: number
  megabytes: number
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
