/** Addresses of the portal's pages. */

/** Sections of the administration page. */
export const REALM_PARTS = ['robots', 'people', 'groups', 'rights', 'relays'] as const
export type RealmPart = (typeof REALM_PARTS)[number]

/** Pages of one address. */
const SIMPLE = ['alerts', 'pipes', 'diagram', 'functions'] as const

export type Route =
  | { page: 'login' }
  | { page: 'fleet' }
  | { page: 'alerts' }
  | { page: 'pipes' }
  | { page: 'diagram' }
  | { page: 'functions' }
  | { page: 'files'; robot: string }
  | { page: 'realm'; part: RealmPart }
  | { page: 'cockpit'; robot: string }
  | { page: 'unknown' }

export function parse(path: string): Route {
  const parts = path.split('/').filter(Boolean)
  if (parts.length === 0 || (parts.length === 1 && parts[0] === 'fleet')) return { page: 'fleet' }
  if (parts.length === 1 && parts[0] === 'login') return { page: 'login' }
  if (parts.length === 1) {
    const page = SIMPLE.find((each) => each === parts[0])
    if (page !== undefined) return { page }
  }
  if (parts[0] === 'realm' && parts.length <= 2) {
    const part = REALM_PARTS.find((each) => each === (parts[1] ?? REALM_PARTS[0]))
    if (part !== undefined) return { page: 'realm', part }
  }
  if (parts[0] === 'files' && parts.length === 1) return { page: 'files', robot: '' }
  if (parts.length === 2 && (parts[0] === 'cockpit' || parts[0] === 'files')) {
    const robot = decoded(parts[1]!)
    if (robot !== null) return { page: parts[0], robot }
  }
  return { page: 'unknown' }
}

function decoded(text: string): string | null {
  try {
    return decodeURIComponent(text)
  } catch {
    return null
  }
}

export const ALERTS = '/alerts'
export const PIPES = '/pipes'
export const DIAGRAM = '/diagram'
export const FUNCTIONS = '/functions'
export const FILES = '/files'

/** @param query filters of the part, such as `robot` and `who` of rights */
export function realmPath(part: RealmPart, query: Record<string, string> = {}): string {
  const asked = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== '')).toString()
  return asked === '' ? `/realm/${part}` : `/realm/${part}?${asked}`
}

export function cockpitPath(robot: string): string {
  return `/cockpit/${encodeURIComponent(robot)}`
}

export function filesPath(robot: string): string {
  return `${FILES}/${encodeURIComponent(robot)}`
}

/** The page after a login; only pages of the portal itself are allowed. */
export function afterLogin(search: string): string {
  const next = new URLSearchParams(search).get('next') ?? ''
  const route = parse(next)
  if (route.page === 'realm') return realmPath(route.part)
  if (route.page === 'cockpit') return cockpitPath(route.robot)
  if (route.page === 'files') return route.robot === '' ? FILES : filesPath(route.robot)
  return route.page === 'login' || route.page === 'unknown' ? '/fleet' : `/${route.page}`
}

/** The one-time code of a login link, e.g. `#code=XYZ`, or null. */
export function loginCode(hash: string): string | null {
  return new URLSearchParams(hash.replace(/^#/, '')).get('code') || null
}
