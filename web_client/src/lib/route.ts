/** Addresses of the portal's pages. */

/** Parts of the page by which an administrator sees to his realm. */
export const REALM_PARTS = ['robots', 'people', 'groups', 'rights'] as const
export type RealmPart = (typeof REALM_PARTS)[number]

export type Route =
  | { page: 'login' }
  | { page: 'fleet' }
  | { page: 'alerts' }
  | { page: 'realm'; part: RealmPart }
  | { page: 'cockpit'; robot: string }
  | { page: 'unknown' }

export function parse(path: string): Route {
  const parts = path.split('/').filter(Boolean)
  if (parts.length === 0 || (parts.length === 1 && parts[0] === 'fleet')) return { page: 'fleet' }
  if (parts.length === 1 && parts[0] === 'login') return { page: 'login' }
  if (parts.length === 1 && parts[0] === 'alerts') return { page: 'alerts' }
  if (parts[0] === 'realm' && parts.length <= 2) {
    const part = REALM_PARTS.find((each) => each === (parts[1] ?? REALM_PARTS[0]))
    if (part !== undefined) return { page: 'realm', part }
  }
  if (parts.length === 2 && parts[0] === 'cockpit') {
    const robot = decoded(parts[1]!)
    if (robot !== null) return { page: 'cockpit', robot }
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

/** @param query what the part shows only, as `robot` or `who` of rights */
export function realmPath(part: RealmPart, query: Record<string, string> = {}): string {
  const asked = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== '')).toString()
  return asked === '' ? `/realm/${part}` : `/realm/${part}?${asked}`
}

export function cockpitPath(robot: string): string {
  return `/cockpit/${encodeURIComponent(robot)}`
}

/** Where to go after logging in: only to a page of the portal itself. */
export function afterLogin(search: string): string {
  const next = new URLSearchParams(search).get('next') ?? ''
  const route = parse(next)
  if (route.page === 'alerts') return ALERTS
  if (route.page === 'realm') return realmPath(route.part)
  return route.page === 'cockpit' ? cockpitPath(route.robot) : '/fleet'
}

/** The one-time code of a login link, e.g. `#code=XYZ`, or null. */
export function loginCode(hash: string): string | null {
  return new URLSearchParams(hash.replace(/^#/, '')).get('code') || null
}
