// Shows a camera on the page /robots/<robot>/video/stream_viewer.
//
// The frames come by websocket: a browser allows six HTTP/1.1 connections to a host, over all its tabs, and an image stream
// would hold one of them. PNG comes as an image stream all the same. A hidden page gives up its connection.
const image = document.querySelector('img')
const words = document.querySelector('p')
const query = new URLSearchParams(location.search)
/** A ticket opens one connection only. */
const reconnects = !query.has('ticket')
const PAUSE_MS = 2000
/** Close codes after which another try has the same end (SPEC 1.4). */
const FINAL = new Set([4400, 4401, 4403, 4404, 4429])

let socket = null
let timer

function connect() {
  clearTimeout(timer)
  const url = new URL(`ws${location.search}`, location.href)
  url.protocol = url.protocol.replace('http', 'ws')
  const opened = new WebSocket(url)
  socket = opened
  opened.binaryType = 'blob'
  let number = null
  opened.onmessage = async ({ data }) => {
    if (typeof data === 'string') {
      const message = JSON.parse(data)
      if (message.op === 'frame') number = message.number
      return
    }
    const received = number
    await show(data)
    if (opened.readyState === WebSocket.OPEN) opened.send(JSON.stringify({ op: 'frame_ack', number: received }))
  }
  opened.onclose = ({ code, reason }) => {
    if (socket !== opened) return
    socket = null
    words.textContent = reason === '' ? 'The connection was lost.' : `${reason}.`
    if (reconnects && !FINAL.has(code) && !document.hidden) timer = setTimeout(connect, PAUSE_MS)
  }
}

async function show(frame) {
  const before = image.src
  const next = URL.createObjectURL(frame)
  const shown = new Promise((resolve) => {
    image.onload = image.onerror = resolve
  })
  image.src = next
  await shown
  words.textContent = ''
  if (before.startsWith('blob:')) URL.revokeObjectURL(before)
}

function disconnect() {
  const closing = socket
  socket = null
  clearTimeout(timer)
  closing?.close()
}

function showStream() {
  image.src = `stream${location.search}`
}

function hideStream() {
  image.removeAttribute('src')
}

const [begin, end] = query.get('type') === 'png' ? [showStream, hideStream] : [connect, disconnect]

document.addEventListener('visibilitychange', () => {
  if (!reconnects) return
  if (document.hidden) end()
  else if (socket === null) begin()
})

// A ticket may have ended when the page is seen.
if (!document.hidden || !reconnects) begin()
