/** Recordings, without user interface. */
import { fileSize, sentence } from '../format'
import type { Recordable, Recording, RecordingState } from './types'

/** The limits of one recording (SPEC 1.9). */
export const MOST_TOPICS = 64
export const MOST_CAMERAS = 8

export const TIMES: [number, string][] = [
  [60, '1 min'],
  [600, '10 min'],
  [3600, '1 h'],
  [21_600, '6 h'],
  [86_400, '24 h'],
]
export const USUAL_SECONDS = 600

const SIZES = [100, 1000, 5000, 20_000]
const LARGEST = 100_000
export const USUAL_MEGABYTES = 1000

export const STATES: Record<RecordingState, { words: string; kind: '' | 'good' | 'warn' | 'bad' }> = {
  recording: { words: 'Recording', kind: 'bad' },
  finishing: { words: 'Finishing', kind: 'warn' },
  complete: { words: 'Complete', kind: 'good' },
  recovered: { words: 'Recovered', kind: 'warn' },
  incomplete: { words: 'Broken off', kind: 'bad' },
}

export function isRunning(recording: Recording): boolean {
  return recording.state === 'recording' || recording.state === 'finishing'
}

export function isReadable(recording: Recording): boolean {
  return recording.state === 'complete' || recording.state === 'recovered'
}

/** Progress towards the limit that ends it, 0 to 1. */
export function progress(recording: Recording): number {
  const time = (recording.lasted ?? 0) / recording.seconds
  return Math.min(1, Math.max(time, recording.bytes / (recording.megabytes * 1e6)))
}

/** Why nothing can be recorded now. */
export interface Obstacle {
  words: string
  /** The command with which the relay's operator can solve it. */
  command?: string
}

/** Why recording is not possible now, or null. */
export function obstacle(possible: Recordable, offline: boolean): Obstacle | null {
  if (possible.denied !== '') return { words: `You may not record this robot. ${sentence(possible.denied)}` }
  const command = 'switchboard serve --recordings-gb'
  if (possible.megabytes === 0) return { words: 'This relay stores no recordings. Start it with space for them:', command }
  if (possible.full !== '') return { words: sentence(possible.full) }
  if (possible.left < 1) {
    const all = fileSize(possible.megabytes * 1e6)
    return {
      words: `No space left: recordings use all ${all}. Delete some, or start the relay with more:`,
      command,
    }
  }
  if (offline) return { words: 'The robot is offline. Recording is possible when it is online.' }
  if (possible.topics.length + possible.cameras.length === 0) return { words: 'There is nothing to record yet.' }
  return null
}

/** Sizes to choose from that fit into the free space. Megabytes and words. */
export function sizes(left: number): [number, string][] {
  const most = Math.min(Math.floor(left), LARGEST)
  const fit: [number, string][] = SIZES.filter((size) => size < most).map((size) => [size, fileSize(size * 1e6)])
  return [...fit, [most, `${fileSize(most * 1e6)}, ${most < LARGEST ? 'all that is left' : 'the most'}`]]
}

/** The largest of these sizes up to the wanted one. */
export function fitting(choices: [number, string][], wanted: number): number {
  const small = choices.map(([size]) => size).filter((size) => size <= wanted)
  return small.at(-1) ?? choices[0]![0]
}

/** Topic under which a camera is recorded. */
export function pictureTopic(camera: string): string {
  return camera.endsWith('/compressed') ? camera : `${camera}/compressed`
}

/** The number of topics and cameras, in words. */
export function contents(topics: number, cameras: number): string {
  const parts = [
    ...(topics > 0 ? [topics === 1 ? '1 topic' : `${topics} topics`] : []),
    ...(cameras > 0 ? [cameras === 1 ? '1 camera' : `${cameras} cameras`] : []),
  ]
  return parts.join(' and ')
}
