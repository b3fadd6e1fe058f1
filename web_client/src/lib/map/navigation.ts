/** Goals of Nav2's actions NavigateToPose and FollowWaypoints: the message, progress and result, in words. */
import { number, sentence, stopwatch } from '../format'
import type { NavigateToPoseFeedback } from '../ros/messages'
import { fromYaw, type Pose2, seconds } from '../ros/transforms'

export const NAVIGATE_TO_POSE = 'nav2_msgs/action/NavigateToPose'
export const FOLLOW_WAYPOINTS = 'nav2_msgs/action/FollowWaypoints'

/** A pose of a frame. */
export interface GoalPose extends Pose2 {
  frame: string
}

/** How a goal ended (action_msgs/msg/GoalStatus); 0: it never began. */
export interface GoalEnd {
  status: number
  /** The result message, or the reason as a string. */
  values: unknown
}

export const SUCCEEDED = 4
const CANCELED = 5

export function goalMessage(goal: GoalPose): object {
  return { pose: stamped(goal), behavior_tree: '' }
}

export function waypointsMessage(goals: GoalPose[]): object {
  return { number_of_loops: 0, goal_index: 0, poses: goals.map(stamped) }
}

function stamped({ x, y, heading, frame }: GoalPose): object {
  // Without a stamp Nav2 takes the newest transform.
  const header = { stamp: { sec: 0, nanosec: 0 }, frame_id: frame }
  return { header, pose: { position: { x, y, z: 0 }, orientation: fromYaw(heading) } }
}

/** Progress as short facts, the most important first. A navigator may leave out what it does not know. */
export function progress(feedback: Partial<NavigateToPoseFeedback>): string[] {
  const { distance_remaining: left, navigation_time: time, estimated_time_remaining: rest } = feedback
  const recoveries = feedback.number_of_recoveries ?? 0
  const found: string[] = []
  if (typeof left === 'number' && Number.isFinite(left)) found.push(`${number(left, left < 10 ? 1 : 0)} m left`)
  if (time != null) found.push(`${stopwatch(seconds(time))} so far`)
  // Nav2 says 0 until it has an estimate.
  if (rest != null && seconds(rest) >= 1) found.push(`${stopwatch(seconds(rest))} to go`)
  if (recoveries > 0) found.push(recoveries === 1 ? '1 recovery' : `${recoveries} recoveries`)
  return found
}

/** Error codes of Nav2's navigator, planner and controller, since Jazzy. */
const ERRORS: Record<number, string> = {
  102: 'the position of the robot is not known',
  103: 'the path could not be followed',
  104: 'the controller found no safe command for too long',
  105: 'the robot made no progress',
  106: 'the controller found no safe command',
  107: 'the controller took too long',
  202: 'the position of the robot is not known',
  203: 'the robot is outside the map',
  204: 'the goal is outside the map',
  205: 'the robot stands where the map shows an obstacle',
  206: 'there is an obstacle at the goal',
  207: 'the planner took too long',
  208: 'there is no path to the goal',
  9001: 'the behaviour tree could not be loaded',
  9002: 'the position of the robot is not known',
  9003: 'it took too long',
}

function reason(values: unknown): string {
  if (typeof values === 'string') return values
  const { error_msg: words, error_code: code } = (values ?? {}) as { error_msg?: unknown; error_code?: unknown }
  if (typeof words === 'string' && words.trim() !== '') return words
  if (typeof code !== 'number' || code === 0) return ''
  return ERRORS[code] ?? `error code ${code}`
}

/** What happened before a goal was cancelled; null if nothing that the page knows of. */
export type Cause = 'robot_stopped' | 'page_cancelled' | 'control_lost' | null

/** The end of a goal, in a sentence. */
export function ended({ status, values }: GoalEnd, cause: Cause): string {
  const why = reason(values)
  const because = (lead: string) => sentence(why === '' ? lead : `${lead}: ${why}`)
  if (status === SUCCEEDED) return 'The robot has arrived.'
  if (status === 0) return because('The goal was refused')
  if (cause === 'robot_stopped') return 'The goal was cancelled, because the robot was stopped.'
  if (status !== CANCELED) return because('The robot did not arrive')
  if (cause === 'page_cancelled') return 'The goal is cancelled.'
  if (cause === 'control_lost') return 'The goal was cancelled, because this page no longer has control.'
  return because('The goal was cancelled')
}
