/** Users connected to a robot (SPEC 1.7, Links and people). */
import type { Stream } from '../ros/messages'
import type { Connection, Person } from './types'

export interface Visitor {
  user: string
  you: boolean
  control: boolean
  /** Unix seconds, of the first connection or camera. */
  since: number
  connections: Connection[]
  /** Each camera once. */
  watching: { camera: string; times: number }[]
}

/** The holder of control first, then by time of connection. */
export function visitors(people: readonly Person[]): Visitor[] {
  return people.map(visitor).sort((a, b) => Number(b.control) - Number(a.control) || a.since - b.since)
}

function visitor({ user, you, control, connections, watching }: Person): Visitor {
  const times = new Map<string, number>()
  for (const { camera } of watching) times.set(camera, (times.get(camera) ?? 0) + 1)
  const since = Math.min(...connections.map((each) => each.since), ...watching.map((each) => each.since))
  const cameras = Array.from(times, ([camera, often]) => ({ camera, times: often }))
  return { user, you, control, since, connections, watching: cameras }
}

/** Current form of a camera stream: "640×480, 12 fps, quality 60"; empty when unknown. */
export function described(camera: string, streams: readonly Stream[]): string {
  const [best] = streams.filter((each) => each.camera === camera).sort((a, b) => (b.width ?? 0) - (a.width ?? 0))
  if (best === undefined) return ''
  const parts = [
    best.width && best.height ? `${best.width}×${best.height}` : '',
    best.fps ? `${Math.round(best.fps)} fps` : '',
    best.codec === 'h264' ? 'H.264' : best.quality ? `quality ${best.quality}` : '',
  ]
  return parts.filter(Boolean).join(', ')
}
