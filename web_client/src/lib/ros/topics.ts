/** Choosing topics by their type. */
import type { TopicInfo } from './messages'

export const SCAN = ['sensor_msgs/msg/LaserScan']
export const ODOMETRY = ['nav_msgs/msg/Odometry']
export const GRID = ['nav_msgs/msg/OccupancyGrid']
export const PATH = ['nav_msgs/msg/Path']
export const MOTION = ['geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped']

/** Types whose messages are large, so that an echo is limited to a few per second. */
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

/** Whether messages of a type are uncompressed images. */
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

/** The default topic: one with a usual last part, otherwise the first.
 *
 * @param usual last parts of names, the most usual first, e.g. `cmd_vel`
 * @param chosen the user's choice, used as long as it exists
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

/** Whether a grid is a costmap of Nav2, by its name. */
export function isCostmap(topic: TopicInfo): boolean {
  return topic.name.includes('costmap')
}

/** The topic with the given last part in the namespace of another, or in the nearest one above it; null for none.
 *
 * @param of name of the other topic, e.g. `/robot1/odom`
 */
export function beside(topics: TopicInfo[], last: string, of: string): TopicInfo | null {
  const parts = of.split('/').slice(0, -1)
  for (; parts.length > 0; parts.pop()) {
    const name = [...parts, last].join('/')
    const found = topics.find((topic) => topic.name === name)
    if (found) return found
  }
  return null
}

/** Topics in which every word of the query occurs, in name or type. */
export function filter(topics: TopicInfo[], query: string): TopicInfo[] {
  const words = query.toLowerCase().split(/\s+/).filter(Boolean)
  return topics.filter((topic) => {
    const text = `${topic.name} ${topic.type}`.toLowerCase()
    return words.every((word) => text.includes(word))
  })
}
