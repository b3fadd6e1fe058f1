import { beforeEach, describe, expect, it } from 'vitest'
import type { StopReason } from './drive'
import { SIGNS, watchDeadman } from './deadman'

class Page extends EventTarget {
  hidden = false
}

let page: { window: Page; document: Page }
let stops: StopReason[]
let end: () => void

beforeEach(() => {
  page = { window: new Page(), document: new Page() }
  stops = []
  end = watchDeadman(page, (reason) => stops.push(reason))
})

function happens(where: 'window' | 'document', name: string, more: object = {}): void {
  const { on, ...rest } = more as { on?: object }
  const event = Object.assign(new Event(name), rest)
  if (on !== undefined) Object.defineProperty(event, 'target', { value: on })
  page[where].dispatchEvent(event)
}

const CASES: ['window' | 'document', string, object, StopReason][] = [
  ['window', 'blur', {}, 'window_left'],
  ['window', 'pagehide', {}, 'page_hidden'],
  ['document', 'freeze', {}, 'page_frozen'],
  ['window', 'offline', {}, 'link_closed'],
  ['window', 'pointercancel', {}, 'pointer_cancelled'],
  ['window', 'contextmenu', {}, 'menu_opened'],
  ['window', 'beforetoggle', { newState: 'open' }, 'dialog_opened'],
  ['window', 'touchstart', { touches: [1, 2] }, 'several_fingers'],
  ['window', 'pointerdown', { on: { tagName: 'SELECT' } }, 'field_entered'],
  ['window', 'focusin', { on: { tagName: 'INPUT', type: 'text' } }, 'field_entered'],
  ['window', 'dragstart', {}, 'drag_began'],
  ['window', 'beforeprint', {}, 'page_printed'],
  ['document', 'fullscreenchange', {}, 'view_changed'],
  ['document', 'pointerlockchange', {}, 'capture_lost'],
]

describe('letting go', () => {
  it.each(CASES)('%s %s stops', (where, name, more, reason) => {
    happens(where, name, more)
    expect(stops).toEqual([reason])
  })

  it('a page that is hidden stops, one that is shown again does not', () => {
    page.document.hidden = true
    happens('document', 'visibilitychange')
    page.document.hidden = false
    happens('document', 'visibilitychange')
    expect(stops).toEqual(['page_hidden'])
  })

  it.each<[string, object]>([
    ['beforetoggle', { newState: 'closed' }],
    ['touchstart', { touches: [1] }],
    ['touchstart', {}],
    ['pointerdown', { on: { tagName: 'INPUT', type: 'range' } }],
    ['pointerdown', {}],
    ['focusin', { on: { tagName: 'BUTTON' } }],
  ])('%s alone does not', (name, more) => {
    happens('window', name, more)
    expect(stops).toEqual([])
  })

  it('a menu that was declined does not', () => {
    const event = new Event('contextmenu', { cancelable: true })
    event.preventDefault()
    page.window.dispatchEvent(event)
    expect(stops).toEqual([])
  })

  it('has a case for every sign it watches', () => {
    const tested = new Set([...CASES.map(([, name]) => name), 'visibilitychange'])
    expect(new Set(SIGNS.map(({ event }) => event))).toEqual(tested)
  })

  it('ends with the page', () => {
    end()
    for (const [where, name, more] of CASES) happens(where, name, more)
    expect(stops).toEqual([])
  })
})
