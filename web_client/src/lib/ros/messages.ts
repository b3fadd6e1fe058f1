/** Messages over the websockets of a robot, as far as the portal reads or sends them.
 *
 * They are written by hand: rosbridge messages and topics of robots are not part of the relay's OpenAPI document. The relay's
 * own are described in SPEC 1.7 and 1.8. Parts that HTTP has too are the generated types.
 */
import type { Client, Level, LinkFacts, Person, RobotState } from '../api/types'

/** `/relay/status`, once a second. */
export interface RelayStatus {
  robot: string
  state: RobotState
  level: Level
  clients: Client[]
  rtt_ms: { relay_robot: number | null }
  links?: Partial<Record<'client_relay' | 'relay_robot' | 'client_robot', LinkFacts>>
  people?: Person[]
  /** Connections and cameras that are not listed. */
  more?: number
  drops: number
  video?: Stream[]
  motion?: { topics: string[]; types: string[]; deadline_ms: number; stop_within_ms: number }
  health?: Partial<Health>
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

export interface Health {
  battery: number | null
  cpu: number | null
  memory: number | null
  rtt_ms: number | null
  stale_commands: number
  watchdog_stops: number
  dropped_samples: number
}

/** The answer of `/relay/ping`. */
export interface Pong {
  relay_time_ns: number
  robot_rtt_ms: number | null
}

/** The answer of the services of control, as `/relay/take_control`. */
export interface ControlReply {
  success: boolean
  message: string
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

export interface Quaternion extends Vector3 {
  w: number
}

export interface Pose {
  position: Vector3
  orientation: Quaternion
}

export interface Time {
  sec: number
  nanosec: number
}

/** A robot that speaks JSON may leave it out. */
export interface Header {
  stamp: Time
  frame_id: string
}

export interface Odometry {
  header?: Header
  child_frame_id?: string
  pose: { pose: Pose }
  twist: { twist: Twist }
}

export interface LaserScan {
  header?: Header
  angle_min: number
  angle_increment: number
  range_min: number
  range_max: number
  /** Metres; null where the robot measured nothing (JSON has no infinity). */
  ranges: (number | null)[]
}

export interface Transform {
  translation: Vector3
  rotation: Quaternion
}

/** tf2_msgs/msg/TFMessage */
export interface TransformMessage {
  transforms: { header: Header; child_frame_id: string; transform: Transform }[]
}

/** nav_msgs/msg/OccupancyGrid */
export interface OccupancyGrid {
  header?: Header
  /** `resolution`: metres along a side of a cell; `origin`: pose of the lower left corner. */
  info: { resolution: number; width: number; height: number; origin: Pose }
  /** Rows from the origin upwards; an `Int8Array` in CBOR. */
  data: Int8Array | number[]
}

/** map_msgs/msg/OccupancyGridUpdate: a rectangle of a grid, in cells. */
export interface OccupancyGridUpdate {
  x: number
  y: number
  width: number
  height: number
  data: Int8Array | number[]
}

/** nav_msgs/msg/Path */
export interface Path {
  header?: Header
  poses: { pose: Pose }[]
}

/** Feedback of nav2_msgs/action/NavigateToPose, as far as the portal reads it. */
export interface NavigateToPoseFeedback {
  navigation_time: Time
  estimated_time_remaining: Time
  number_of_recoveries: number
  /** Metres along the path. */
  distance_remaining: number
}

/** Feedback of nav2_msgs/action/FollowWaypoints. */
export interface FollowWaypointsFeedback {
  current_waypoint: number
}

/** Precedes each picture on the websocket of a camera. */
export interface PictureHeader {
  number: number
  /** Unix time at the robot, seconds. */
  stamp: number
  codec: string
  /** Whether it stands alone. */
  key: boolean
  /** Whether it may have been kept before it was sent, so that its stamp alone tells how old it is; told by the link. */
  kept: boolean
}

/** `stream_status` on the websocket of a camera: what the robot sends now. */
export interface Playing {
  width: number
  height: number
  quality: number
  /** 0 for all there are. */
  fps: number
  /** How far below what was asked for: 0 as asked, 1 the least there is. */
  reduced: number
  source_fps: number
  /** Of another form that is shown in the place of the one asked for: in what it differs; null: it is as asked. */
  instead?: Record<string, unknown> | null
  /** Why no picture has come for a while though the camera gives some; empty while all is well. */
  problem?: string
}
