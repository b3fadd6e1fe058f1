/** Decoding camera pictures: the newest wins, a backlog is never decoded. */
import type { CompressedImage } from './types'

export type Decode = (message: CompressedImage) => Promise<ImageBitmap>

export class PictureFeed {
  private waiting: CompressedImage | null = null
  private busy = false
  private closed = false
  /** Pictures passed over because a newer one came first. */
  skipped = 0

  /**
   * @param decode one at a time
   * @param show gets each decoded picture and owns it
   * @param failed told when a picture can't be decoded
   */
  constructor(
    private readonly decode: Decode,
    private readonly show: (picture: ImageBitmap) => void,
    private readonly failed: (message: CompressedImage) => void,
  ) {}

  push(message: CompressedImage): void {
    if (this.waiting !== null) this.skipped += 1
    this.waiting = message
    void this.work()
  }

  close(): void {
    this.closed = true
    this.waiting = null
  }

  private async work(): Promise<void> {
    if (this.busy) return
    this.busy = true
    while (this.waiting !== null) {
      const message: CompressedImage = this.waiting
      this.waiting = null
      try {
        const picture = await this.decode(message)
        if (this.closed) picture.close()
        else this.show(picture)
      } catch {
        if (!this.closed) this.failed(message)
      }
    }
    this.busy = false
  }
}

/** The media type of a CompressedImage; null for encodings a browser has no decoder for. */
export function mediaType(format: string): string | null {
  const text = format.toLowerCase()
  if (text.includes('compresseddepth')) return null
  if (text.includes('png')) return 'image/png'
  if (text.includes('webp')) return 'image/webp'
  return text === '' || text.includes('jpeg') || text.includes('jpg') ? 'image/jpeg' : null
}

export function bytes(base64: string): Uint8Array<ArrayBuffer> {
  const text = atob(base64)
  const found = new Uint8Array(text.length)
  for (let i = 0; i < text.length; i++) found[i] = text.charCodeAt(i)
  return found
}

/** Decodes with the browser's own decoder. */
export const decodeInBrowser: Decode = async (message) => {
  const type = mediaType(message.format)
  if (type === null) throw new TypeError(`No decoder for '${message.format}'.`)
  return createImageBitmap(new Blob([bytes(message.data)], { type }))
}
