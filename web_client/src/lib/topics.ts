/** Choosing topics by their type. */
import type { TopicInfo } from './types'

export const SCAN = ['sensor_msgs/msg/LaserScan']
export const ODOMETRY = ['nav_msgs/msg/Odometry']
export const MOTION = ['geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped']

/** Types whose messages are so large that an echo takes only a few of them. */
const HEAVY = new Set([
  'sensor_msgs/msg/Image',
  'sensor_msgs/msg/CompressedImage',
  'sensor_msgs/msg/PointCloud2',
  'nav_msgs/msg/OccupancyGrid',
])

export const HEAVY_THROTTLE_MS = 500

/** A type in its ROS 2 spelling: some rosapi implementations leave out the `msg`. */
export function fullType(type: string): string {
  const parts = type.split('/')
  return parts.length === 2 ? `${parts[0]}/msg/${parts[1]}` : type
}

export function isHeavy(type: string): boolean {
  return HEAVY.has(fullType(type))
}

/** Whether messages of a type are whole pictures, uncompressed. */
export function isPicture(type: string): boolean {
  return fullType(type) === 'sensor_msgs/msg/Image'
}

/** Topics of some types, in the order of the types, then by the shortest name. */
export function ofType(topics: TopicInfo[], types: string[]): TopicInfo[] {
  return topics
    .filter((topic) => types.includes(fullType(topic.type)))
    .sort(
      (a, b) =>
        types.indexOf(fullType(a.type)) - types.indexOf(fullType(b.type)) ||
        a.name.length - b.name.length ||
        a.name.localeCompare(b.name),
    )
}

/** The topic to take when nobody has chosen: one with a usual last name, else the first.
 *
 * @param usual last parts of names, the most usual first, e.g. `cmd_vel`
 * @param chosen what the user took; kept as long as it exists
 */
export function pick(candidates: TopicInfo[], usual: string[], chosen: string | null): TopicInfo | null {
  const kept = candidates.find((topic) => topic.name === chosen)
  if (kept) return kept
  for (const name of usual) {
    const found = candidates.find((topic) => topic.name.split('/').at(-1) === name)
    if (found) return found
  }
  return candidates[0] ?? null
}

/** Topics in which every word of the query occurs, in name or type. */
export function filter(topics: TopicInfo[], query: string): TopicInfo[] {
  const words = query.toLowerCase().split(/\s+/).filter(Boolean)
  return topics.filter((topic) => {
    const text = `${topic.name} ${topic.type}`.toLowerCase()
    return words.every((word) => text.includes(word))
  })
}
