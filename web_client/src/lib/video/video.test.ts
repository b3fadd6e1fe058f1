import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { videoSocket } from '../api/api'
import { NOT_AS_H264, videoEnding } from '../api/closeCodes'
import { moment } from '../format'
import { codecName, h264Missing } from './h264'
import { age, ageWords, type Close, fileName, insteadWords, missedAfter, MOST_PANES, parameters, pickCamera, PLAIN, restored, silence, SILENT_MS, silentAfter, sinceWhen, VideoLink } from './video'
import type { PictureHeader } from '../ros/messages'

const compressed = (name: string) => ({ name, type: 'sensor_msgs/msg/CompressedImage' })
const raw = (name: string) => ({ name, type: 'sensor_msgs/msg/Image' })

it('takes a camera that needs no encoding, and a depth picture last', () => {
  const depth = compressed('/a/depth/compressed')
  expect(pickCamera([raw('/a'), depth, compressed('/front/image/compressed')])).toBe('/front/image/compressed')
  expect(pickCamera([depth, raw('/cam/image_raw')])).toBe('/cam/image_raw')
  expect(pickCamera([])).toBeNull()
})

it('adds a camera that is not shown yet, as long as there is one', () => {
  const all = [compressed('/a'), compressed('/b')]
  expect(pickCamera(all, ['/a'])).toBe('/b')
  expect(pickCamera(all, ['/a', '/b'])).toBe('/a')
})

it('asks only for what is not as usual', () => {
  expect(parameters('/cam/image', PLAIN)).toBe('topic=%2Fcam%2Fimage')
  const request = { ...PLAIN, width: 640, fps: 5, rotate: 90, codec: 'h264' as const }
  expect(parameters('/cam', request)).toBe('topic=%2Fcam&width=640&fps=5&rotate=90&codec=h264')
  expect(videoSocket('r 1', 'topic=a', { protocol: 'https:', host: 'h' })).toBe('wss://h/robots/r%201/video/ws?topic=a')
})

it('restores what was shown, and passes over what makes no sense', () => {
  expect(restored(undefined)).toEqual([PLAIN])
  expect(restored('x')).toEqual([PLAIN])
  expect(restored([null, { camera: '/a', width: 641, quality: 40, fps: '5', codec: 'vp9' }])).toEqual([
    { ...PLAIN, camera: '/a', quality: 40 },
  ])
  expect(restored(Array(9).fill(PLAIN)).length).toBe(MOST_PANES)
})

it('misses a picture after a second, or later where they come slowly', () => {
  expect(missedAfter(0, null)).toBe(1000)
  expect(missedAfter(15, { fps: 0, source_fps: 30 })).toBe(1000)
  expect(missedAfter(1, { fps: 1, source_fps: 30 })).toBe(2500)
  expect(missedAfter(0, { fps: 0, source_fps: 0.5 })).toBe(5000)
  expect(missedAfter(0, null, 0.05)).toBe(50_000)
  expect(missedAfter(15, { fps: 0, source_fps: 30 }, 0.05)).toBe(1000)
})

const live = { stamp: 1000, kept: false, drawnMs: 500 }
const kept = { ...live, kept: true }

it('tells the age by the relay’s clock, and not at all when the robot’s can’t be right', () => {
  expect(age(live, 1_000_080)).toBe(80)
  expect(age(live, 999_950)).toBe(0)
  expect(age(live, null)).toBeNull()
  expect(age(live, 990_000)).toBeNull()
  expect(age(live, 1_060_000)).toBeNull()
})

it('takes one that was kept for as old as its stamp says', () => {
  expect(age(kept, 1_060_000)).toBe(60_000)
  expect(age(kept, 999_950)).toBe(0)
  expect(age(kept, 990_000)).toBeNull()
})

it('counts from the stamp of a picture that was kept, and else from when it was drawn', () => {
  expect(silence(kept, 500, 1_050_000)).toBe(50_000)
  expect(silence(kept, 2500, 1_052_000)).toBe(52_000)
  expect(silence(live, 2500, 1_052_000)).toBe(2000)
  // The robot's clock is ahead: it was taken no later than it was drawn.
  expect(silence(kept, 2500, 900_000)).toBe(2000)
})

it('says since when there is no picture', () => {
  expect(sinceWhen(live, 1999, 1_001_499, 1000)).toBe('No frame for 1 s')
  expect(sinceWhen(kept, 1500, 1_051_000, 1000)).toBe('No frame for 51 s')
  expect(sinceWhen(live, 120_500, 1_120_000, 1000)).toBe('No frame for 2 min')
  expect(sinceWhen(live, 7_200_500, 8_200_000, 1000)).toBe('No frame for 2 h')
})

it('says no more than when it was of one that nothing but its publisher keeps so long', () => {
  const hour = sinceWhen(kept, 1500, 4_601_000, 1000)
  expect(hour).toBe(`Frame of ${moment(1000, 4601)}, by the robot’s clock`)
  expect(sinceWhen(kept, 60_500, 4_660_000, 1000)).toBe(hour)
  // What began as the newest does not become another one while it is shown.
  expect(sinceWhen(kept, 60_500, 1_100_000, 1000)).toBe('No frame for 100 s')
  // One in two minutes.
  expect(sinceWhen(kept, 500, 1_400_000, 300_000)).toBe('No frame for 6 min')
})

it('lets the age of a picture grow while it is shown', () => {
  expect(ageWords(null, 0)).toBe('age unknown')
  expect(ageWords(0.4, 0)).toBe('< 1 ms old')
  expect(ageWords(80, 900)).toBe('80 ms old')
  expect(ageWords(80, 2000)).toBe('2 s old')
  expect(ageWords(45_000, 0)).toBe('45 s old')
  expect(ageWords(45_000, 3500)).toBe('48 s old')
})

it('names a snapshot after robot, camera and time', () => {
  const name = fileName('rover-1', '/camera/image raw/../x', Date.UTC(2026, 10, 21, 17, 3, 4, 56) / 1000)
  expect(name).toBe('rover-1-camera-image-raw-x-2026-11-21T17-03-04-056Z.jpg')
})

it('says in words why a camera’s pictures ended', () => {
  expect(videoEnding(4403, 'revoked by admin')).toEqual({
    after: 'give_up',
    words: 'You have no right to view this camera. Revoked by admin.',
  })
  expect(videoEnding(4404, 'there is no such camera').words).toBe('This camera does not exist, or you may not view it.')
  expect(videoEnding(4401, 'x').after).toBe('login')
  for (const code of [4400, 4404, 4429]) expect(videoEnding(code, '').after).toBe('give_up')
  for (const code of [1001, 1006, 1011, 4408, NOT_AS_H264, 4503, 4999]) expect(videoEnding(code, '').after).toBe('retry')
})

it('says why there is no H.264', () => {
  expect(h264Missing({ isSecureContext: false })).toContain('https')
  expect(h264Missing({ isSecureContext: true })).toContain('WebCodecs')
  expect(h264Missing({ isSecureContext: true, VideoDecoder: {} })).toBeNull()
})

it('reads the codec from the parameters of a key frame', () => {
  const delimiter = [0, 0, 0, 1, 0x09, 0x10]
  const parameters = [0, 0, 0, 1, 0x67, 0x42, 0xc0, 0x1e, 0xd9]
  expect(codecName(new Uint8Array([...delimiter, ...parameters, 0, 0, 1, 0x65]))).toBe('avc1.42c01e')
  expect(codecName(new Uint8Array([...delimiter, 0, 0, 1, 0x41, 1, 2, 3, 4]))).toBeNull()
  expect(codecName(new Uint8Array([0, 0, 1, 0x67]))).toBeNull()
})

class FakeSocket {
  binaryType = ''
  sent: string[] = []
  closed: number | null = null
  onopen: () => void = () => undefined
  onclose: (event: { code: number; reason: string }) => void = () => undefined
  onmessage: (event: { data: unknown }) => void = () => undefined

  send(text: string) {
    this.sent.push(text)
  }
  close(code = 1005) {
    this.closed = code
  }
  picture(number: number, stamp = number) {
    this.onmessage({ data: JSON.stringify({ op: 'frame', number, stamp, codec: 'jpeg', key: true }) })
    this.onmessage({ data: new ArrayBuffer(8) })
  }
}

function opened(
  picture: (header: PictureHeader) => Promise<void> = () => Promise.resolve(),
  silentMs: () => number = () => SILENT_MS,
) {
  const sockets: FakeSocket[] = []
  const states: [string, number | null][] = []
  const events = {
    state: (state: string, _why: unknown, close: Close | null) => states.push([state, close?.code ?? null]),
    playing: vi.fn(),
    picture: vi.fn(picture),
  }
  const dial = () => {
    const socket = new FakeSocket()
    sockets.push(socket)
    return socket as unknown as WebSocket
  }
  const link = new VideoLink('ws://r', events, silentMs, dial)
  link.open()
  sockets[0]!.onopen()
  return { link, sockets, states, events }
}

beforeEach(() => {
  vi.useFakeTimers()
  vi.spyOn(Math, 'random').mockReturnValue(0.5)
})
afterEach(() => {
  vi.useRealTimers()
  vi.restoreAllMocks()
})

it('takes a picture only when it was drawn', async () => {
  let drawn = () => undefined as void
  const { sockets } = opened(() => new Promise((done) => (drawn = done)))
  sockets[0]!.picture(7)
  await vi.advanceTimersByTimeAsync(50)
  expect(sockets[0]!.sent).toEqual([])
  drawn()
  await vi.advanceTimersByTimeAsync(0)
  expect(sockets[0]!.sent).toEqual(['{"op":"frame_ack","number":7}'])
})

it('takes the first picture of a connection, and of what the robot begins resetKey, for one that may have been kept', async () => {
  const { sockets, events } = opened()
  for (const number of [5, 6, 9, 1, 2]) sockets[0]!.picture(number)
  sockets[0]!.onclose({ code: 1006, reason: '' })
  await vi.advanceTimersByTimeAsync(500)
  for (const number of [3, 4]) sockets[1]!.picture(number)
  const shown = events.picture.mock.calls.map(([header]) => [header.number, header.kept])
  expect(shown.filter(([, kept]) => kept)).toEqual([
    [5, true],
    [1, true],
    [3, true],
  ])
  expect(shown.length).toBe(7)
})

it('takes a picture that comes once more for no newer one', () => {
  const { sockets, events } = opened()
  for (const [number, stamp] of [[1, 100], [2, 101], [7, 101], [8, 102]] as const) sockets[0]!.picture(number, stamp)
  expect(events.picture.mock.calls.map(([header]) => header.kept)).toEqual([true, false, true, false])
})

it('hands on what the robot says about its stream', () => {
  const { sockets, events } = opened()
  sockets[0]!.onmessage({ data: '{"op":"stream_status","width":640,"reduced":0.5}' })
  sockets[0]!.onmessage({ data: '{"op":"something new"}' })
  expect(events.playing).toHaveBeenCalledExactlyOnceWith({ op: 'stream_status', width: 640, reduced: 0.5 })
})

it('comes back after pauses that grow until a picture comes', async () => {
  const { sockets, states } = opened()
  for (const [attempt, waited] of [500, 1000, 2000].entries()) {
    sockets[attempt]!.onopen()
    sockets[attempt]!.onclose({ code: 4503, reason: '' })
    await vi.advanceTimersByTimeAsync(waited - 1)
    expect(sockets.length).toBe(attempt + 1)
    await vi.advanceTimersByTimeAsync(1)
    expect(sockets.length).toBe(attempt + 2)
  }
  expect(states).toContainEqual(['waiting', 4503])
  sockets[3]!.picture(1)
  sockets[3]!.onclose({ code: 1006, reason: '' })
  await vi.advanceTimersByTimeAsync(500)
  expect(sockets.length).toBe(5)
})

it('gives up where trying again is useless, until it is told to', async () => {
  const { link, sockets, states } = opened()
  sockets[0]!.onclose({ code: 4403, reason: '' })
  expect(states.at(-1)).toEqual(['ended', 4403])
  await vi.advanceTimersByTimeAsync(60_000)
  expect(sockets.length).toBe(1)
  link.retryNow()
  expect(sockets.length).toBe(2)
})

it('dials again when a connection falls silent', async () => {
  const { sockets } = opened()
  await vi.advanceTimersByTimeAsync(SILENT_MS - 1)
  sockets[0]!.picture(1)
  await vi.advanceTimersByTimeAsync(SILENT_MS - 1)
  expect(sockets[0]!.closed).toBeNull()
  await vi.advanceTimersByTimeAsync(501)
  expect(sockets[0]!.closed).not.toBeNull()
  expect(sockets.length).toBe(2)
})

it('waits as long for a slow camera as the relay does, and a little longer', async () => {
  let missed = 1000
  const { sockets } = opened(undefined, () => silentAfter(missed))
  missed = missedAfter(0, null, 0.05)
  sockets[0]!.onmessage({ data: '{"op":"stream_status","source_fps":0.05}' })
  await vi.advanceTimersByTimeAsync(50_000)
  expect(sockets[0]!.closed).toBeNull()
  await vi.advanceTimersByTimeAsync(5501)
  expect(sockets.length).toBe(2)
  expect(silentAfter(1000)).toBe(SILENT_MS)
  expect(silentAfter(2.5e6)).toBe(125_000)
})

it('is quiet once it is closed', async () => {
  let drawn = () => undefined as void
  const { link, sockets, states } = opened(() => new Promise((done) => (drawn = done)))
  sockets[0]!.picture(1)
  link.close()
  drawn()
  const before = states.length
  sockets[0]!.onclose({ code: 1000, reason: '' })
  await vi.advanceTimersByTimeAsync(60_000)
  expect(sockets[0]!.sent).toEqual([])
  expect(states.length).toBe(before)
  expect(sockets.length).toBe(1)
})

it('tells in what the form differs that is shown in the place of another', () => {
  expect(insteadWords({ width: 0, quality: 60 })).toContain('requested (width the camera’s own, quality 60), until')
  expect(insteadWords({ stamp: true })).toContain('requested, until another one ends')
})
