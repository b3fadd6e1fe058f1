/** Stands in for roslib's decoders of encodings the portal never subscribes to (BSON, CBOR, PNG) and for Node's socket. */
const never = (): never => {
  throw new Error('The portal does not ask for this encoding.')
}

export const deserialize = never
export const decode = never
export class WebSocket {
  constructor() {
    never()
  }
}
