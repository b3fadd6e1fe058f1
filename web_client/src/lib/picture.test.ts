import { expect, it, vi } from 'vitest'
import { bytes, mediaType, PictureFeed } from './picture'
import type { CompressedImage } from './types'

const image = (data: string): CompressedImage => ({ format: 'jpeg', data })
const bitmap = (name: string) => ({ name, close: vi.fn() }) as unknown as ImageBitmap & { name: string }
const settle = () => new Promise((done) => setTimeout(done))

function slowDecoder() {
  const jobs: { data: string; finish: (b: ImageBitmap) => void; fail: () => void }[] = []
  const decode = (message: CompressedImage) =>
    new Promise<ImageBitmap>((finish, reject) => {
      jobs.push({ data: message.data, finish, fail: () => reject(new Error('broken')) })
    })
  return { jobs, decode }
}

it('decodes one at a time and passes over all but the newest', async () => {
  const { jobs, decode } = slowDecoder()
  const shown: string[] = []
  const feed = new PictureFeed(decode, (picture) => shown.push((picture as ReturnType<typeof bitmap>).name), vi.fn())
  for (const name of ['1', '2', '3', '4']) feed.push(image(name))
  expect(jobs.map((job) => job.data)).toEqual(['1'])
  jobs[0]!.finish(bitmap('1'))
  await settle()
  expect(jobs.map((job) => job.data)).toEqual(['1', '4'])
  jobs[1]!.finish(bitmap('4'))
  await settle()
  expect(shown).toEqual(['1', '4'])
  expect(feed.skipped).toBe(2)
})

it('goes on after a picture that can not be decoded', async () => {
  const { jobs, decode } = slowDecoder()
  const [show, failed] = [vi.fn(), vi.fn()]
  const feed = new PictureFeed(decode, show, failed)
  feed.push(image('bad'))
  jobs[0]!.fail()
  await settle()
  feed.push(image('good'))
  jobs[1]!.finish(bitmap('good'))
  await settle()
  expect(failed).toHaveBeenCalledWith(image('bad'))
  expect(show).toHaveBeenCalledTimes(1)
})

it('frees a picture that comes after it was closed, and shows nothing', async () => {
  const { jobs, decode } = slowDecoder()
  const show = vi.fn()
  const feed = new PictureFeed(decode, show, vi.fn())
  feed.push(image('1'))
  feed.close()
  const late = bitmap('1')
  jobs[0]!.finish(late)
  await settle()
  expect(late.close).toHaveBeenCalled()
  expect(show).not.toHaveBeenCalled()
})

it('knows the media type of the formats ROS writes', () => {
  expect(mediaType('jpeg')).toBe('image/jpeg')
  expect(mediaType('rgb8; jpeg compressed bgr8')).toBe('image/jpeg')
  expect(mediaType('mono8; png compressed ')).toBe('image/png')
  expect(mediaType('32FC1; compressedDepth png')).toBeNull()
  expect(mediaType('h264')).toBeNull()
})

it('decodes base64', () => {
  expect(Array.from(bytes('/9j/'))).toEqual([0xff, 0xd8, 0xff])
})
