import { expect, it } from 'vitest'
import { filter, isHeavy, MOTION, ofType, pick } from './topics'

const TOPICS = [
  { name: '/scan', type: 'sensor_msgs/msg/LaserScan' },
  { name: '/cmd_vel_stamped', type: 'geometry_msgs/msg/TwistStamped' },
  { name: '/nav/cmd_vel', type: 'geometry_msgs/msg/Twist' },
  { name: '/r1/teleop', type: 'geometry_msgs/Twist' },
  { name: '/cam/image_raw/compressed', type: 'sensor_msgs/msg/CompressedImage' },
]

it('finds topics by type, in either spelling of it', () => {
  expect(ofType(TOPICS, MOTION).map((t) => t.name)).toEqual(['/r1/teleop', '/nav/cmd_vel', '/cmd_vel_stamped'])
})

it('takes the usual name behind any namespace, else the first', () => {
  const motion = ofType(TOPICS, MOTION)
  expect(pick(motion, ['cmd_vel'], null)?.name).toBe('/nav/cmd_vel')
  expect(pick(motion, ['unknown'], null)?.name).toBe('/r1/teleop')
  expect(pick([], ['cmd_vel'], null)).toBeNull()
})

it('keeps what the user chose as long as it exists', () => {
  const motion = ofType(TOPICS, MOTION)
  expect(pick(motion, ['cmd_vel'], '/r1/teleop')?.name).toBe('/r1/teleop')
  expect(pick(motion, ['cmd_vel'], '/gone')?.name).toBe('/nav/cmd_vel')
})

it('filters by every word, in name and type', () => {
  expect(filter(TOPICS, ' twist nav ').map((t) => t.name)).toEqual(['/nav/cmd_vel'])
  expect(filter(TOPICS, '').length).toBe(TOPICS.length)
})

it('knows types too large to echo in full', () => {
  expect(isHeavy('sensor_msgs/PointCloud2')).toBe(true)
  expect(isHeavy('sensor_msgs/msg/LaserScan')).toBe(false)
})
