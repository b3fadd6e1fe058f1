import { expect, it } from 'vitest'
import { described, visitors } from './presence'
import type { Connection, Person } from './types'

const connection = (client: number, since: number): Connection => ({
  client,
  since,
  you: false,
  control: false,
  rtt_ms: 3,
  robot_rtt_ms: null,
  quality: 'good',
  drops: 0,
  address: '',
})
const person = (user: string, more: Partial<Person>): Person => ({
  user,
  you: false,
  control: false,
  connections: [],
  watching: [],
  ...more,
})

it('names who has control first, then who came first', () => {
  const people = [
    person('ann', { connections: [connection(1, 50)] }),
    person('bob', { watching: [{ camera: '/c', since: 10, address: '' }] }),
    person('eve', { control: true, connections: [connection(2, 90)] }),
  ]
  expect(visitors(people).map(({ user }) => user)).toEqual(['eve', 'bob', 'ann'])
})

it('says since when somebody is here, and each camera once', () => {
  const watching = [
    { camera: '/c', since: 20, address: '' },
    { camera: '/c', since: 30, address: '' },
  ]
  const [ann] = visitors([person('ann', { connections: [connection(1, 25)], watching })])
  expect(ann).toMatchObject({ since: 20, watching: [{ camera: '/c', times: 2 }] })
})

it('says in what form a camera is shown, the largest where there are several', () => {
  const streams = [
    { camera: '/c', codec: 'jpeg', viewers: 1, width: 320, height: 240, quality: 60, fps: 5 },
    { camera: '/c', codec: 'jpeg', viewers: 1, width: 640, height: 480, quality: 80, fps: 12.4 },
    { camera: '/d', codec: 'h264', viewers: 1, width: null, height: null, fps: null },
  ]
  expect(described('/c', streams)).toBe('640×480, 12 fps, quality 80')
  expect(described('/d', streams)).toBe('H.264')
  expect(described('/e', streams)).toBe('')
})
