//! Where the reader is. All of a view's state is in the address, so that every view is a link.
import { BASE, siteHref } from './base'
import { changeSearch, parseSearch, type SearchChanges } from './search'

/** The path of an address of this site, from the root of its pages. */
const pathOf = (pathname: string) => pathname.slice(BASE.length) || '/'
const read = () => ({ path: pathOf(location.pathname), search: location.search })

let here = $state(read())

/** Decodes a part of a path; undefined if it is malformed, as `%zz` is. */
export function decodePart(part: string): string | undefined {
  try {
    return decodeURIComponent(part)
  } catch {
    return undefined
  }
}

/** The current address, reactive. */
export const place = {
  /** As it stands in the address, with its percent signs. */
  get path(): string {
    return here.path
  },
  get search(): string {
    return here.search
  },
  get params(): URLSearchParams {
    return parseSearch(here.search)
  },
}

/** Goes to an address of this site. */
export function go(href: string, replace = false): void {
  if (href === location.pathname + location.search) return
  if (replace) history.replaceState(null, '', href)
  else history.pushState(null, '', href)
  here = read()
}

/** The address of a page with some parameters changed; null or '' removes one, a list repeats it. */
export function withParams(changes: SearchChanges, path = pathOf(location.pathname)): string {
  return changeSearch(siteHref(path), path === pathOf(location.pathname) ? here.search : '', changes)
}

/** Changes parameters in place; `push` makes it a step that Back undoes. */
export function setParams(changes: SearchChanges, push = false): void {
  go(withParams(changes), !push)
}

/** The address of a surface, of one of its pairs, of a run. */
export const surfaceHref = (id: string) => siteHref(`/surfaces/${encodeURIComponent(id)}`)
export const pairHref = (id: string, pair: number) => `${surfaceHref(id)}/pairs/${pair}`
export const runHref = (id: string) => siteHref(`/runs/${encodeURIComponent(id)}`)

/** The address of a comparison, and of the map at a surface. */
export const compareHref = (ids: readonly string[]) => siteHref(`/compare?s=${ids.map(encodeURIComponent).join(',')}`)
export const mapAtHref = (id: string) => siteHref(`/map?at=${encodeURIComponent(id)}`)

/** Plain clicks on this site's links stay in the page. */
export function follow(): void {
  addEventListener('popstate', () => {
    here = read()
  })
  addEventListener('click', (event) => {
    if (
      event.defaultPrevented ||
      event.button !== 0 ||
      event.metaKey ||
      event.ctrlKey ||
      event.shiftKey ||
      event.altKey
    )
      return
    const link = (event.target as Element | null)?.closest?.('a')
    if (!link || link.target || link.hasAttribute('download') || link.origin !== location.origin) return
    if (!link.pathname.startsWith(`${BASE}/`) || /^\/(api|health|metrics)/.test(pathOf(link.pathname))) return
    event.preventDefault()
    // A place within the page; its address stays, because that names the view.
    if (link.hash && link.pathname === location.pathname) {
      document.getElementById(link.hash.slice(1))?.focus()
      return
    }
    go(link.pathname + link.search)
    scrollTo(0, 0)
  })
}
