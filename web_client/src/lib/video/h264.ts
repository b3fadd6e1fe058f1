/** H.264 by the browser's own decoder (WebCodecs), which only pages over a secure connection have. */
import type { PictureHeader } from '../ros/messages'

/** Why a page cannot show H.264, or null if it can. */
export function h264Missing(page: { isSecureContext: boolean; VideoDecoder?: unknown }): string | null {
  if (!page.isSecureContext) return 'H.264 needs https: over plain http browsers offer no decoder.'
  return page.VideoDecoder === undefined ? 'This browser has no decoder for H.264 (WebCodecs).' : null
}

const SEQUENCE_PARAMETERS = 7

/** The browsers' name of the codec, from the parameter set of a key frame (Annex B); null if it has none. */
export function codecName(picture: Uint8Array): string | null {
  for (let at = 0; at + 6 < picture.length; at++) {
    const starts = picture[at] === 0 && picture[at + 1] === 0 && picture[at + 2] === 1
    if (!starts || (picture[at + 3]! & 0x1f) !== SEQUENCE_PARAMETERS) continue
    const profile = [...picture.subarray(at + 4, at + 7)]
    return `avc1.${profile.map((byte) => byte.toString(16).padStart(2, '0')).join('')}`
  }
  return null
}

/** A decoder may hold a frame back until the next one, which the relay sends only after this one is acknowledged. */
const HELD_MS = 100

export class H264Decoder {
  private readonly decoder: VideoDecoder
  private codec: string | null = null
  /** Frames inside the decoder, by their timestamp. */
  private readonly inside = new Map<number, { header: PictureHeader; taken: () => void }>()

  /**
   * @param show gets each decoded frame and owns it
   * @param failed called once, when decoding has failed
   */
  constructor(show: (frame: VideoFrame, header: PictureHeader) => void, failed: () => void) {
    this.decoder = new VideoDecoder({
      output: (frame) => {
        const found = this.inside.get(frame.timestamp)
        this.inside.delete(frame.timestamp)
        if (found === undefined) return frame.close()
        show(frame, found.header)
        found.taken()
      },
      error: () => {
        this.closeDecoder()
        failed()
      },
    })
  }

  /** Resolves when the frame was shown, or cannot be. */
  async decode(header: PictureHeader, body: ArrayBuffer): Promise<void> {
    if (this.decoder.state === 'closed') return
    if (header.key) this.configure(codecName(new Uint8Array(body)))
    // Nothing can be decoded before the first key frame.
    if (this.codec === null) return
    const taken = new Promise<void>((done) => this.inside.set(header.number, { header, taken: done }))
    const type = header.key ? 'key' : 'delta'
    this.decoder.decode(new EncodedVideoChunk({ type, timestamp: header.number, data: body }))
    await Promise.race([taken, new Promise((done) => setTimeout(done, HELD_MS))])
  }

  close(): void {
    this.closeDecoder()
    if (this.decoder.state !== 'closed') this.decoder.close()
  }

  private configure(codec: string | null): void {
    if (codec === null || codec === this.codec) return
    this.codec = codec
    this.closeDecoder()
    this.decoder.configure({ codec, optimizeForLatency: true })
  }

  private closeDecoder(): void {
    for (const { taken } of this.inside.values()) taken()
    this.inside.clear()
  }
}
