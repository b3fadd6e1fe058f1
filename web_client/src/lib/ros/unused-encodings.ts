/** Replaces roslib's decoders of encodings that the portal never requests (BSON, PNG), and Node's socket. */
const never = (): never => {
  throw new Error('The portal does not use this encoding.')
}

export const deserialize = never
export const decode = never
export class WebSocket {
  constructor() {
    never()
  }
}
