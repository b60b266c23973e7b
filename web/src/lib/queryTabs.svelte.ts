//! Queries that are open side by side. They are kept in the browser, like those that were run.
import { mayKeep, readList, writeList } from './stored'

export interface QueryTab {
  readonly id: string
  readonly name: string
  readonly text: string
  /** What of it was run; another visit begins with its answer. */
  readonly ran: string
  /** Whether somebody wrote in it. What a click opened takes the place of what another click did, if nobody did. */
  readonly isOwn: boolean
}

const NAME = 'tabs'
const stored = () =>
  readList<QueryTab>(NAME, (one) => [one.id, one.name, one.text, one.ran].every((part) => typeof part === 'string'))

let tabs = $state.raw<readonly QueryTab[]>(stored())
let active = $state('')

/** Changes one in the list of this page, and in what is stored, where another page may have added some. */
function change(id: string, next: QueryTab | undefined): void {
  const put = (list: readonly QueryTab[], isKept: boolean) => {
    if (!next || !isKept) return list.filter((one) => one.id !== id)
    return list.some((one) => one.id === id) ? list.map((one) => (one.id === id ? next : one)) : [...list, next]
  }
  tabs = put(tabs, true)
  writeList(NAME, put(stored(), next !== undefined && mayKeep(next.text)))
}

export const queryTabs = {
  get all() {
    return tabs
  },
  get active(): QueryTab | undefined {
    return tabs.find((one) => one.id === active)
  },
  choose(id: string): void {
    active = id
  },
  /** Opens a text, where it is open already, or instead of one that nobody wrote in. */
  open(text: string, name = ''): void {
    const same = tabs.find((one) => bare(one.text) === bare(text))
    active = same?.id ?? tabs.find((one) => !one.isOwn)?.id ?? newId()
    if (!same) change(active, { id: active, name: name || nextName(), text, ran: '', isOwn: false })
  },
  /** Opens an empty one. */
  add(): void {
    active = newId()
    change(active, { id: active, name: nextName(), text: '', ran: '', isOwn: true })
  },
  update(id: string, part: Partial<QueryTab>): void {
    const old = tabs.find((one) => one.id === id)
    if (old) change(id, { ...old, ...part })
  },
  close(id: string): void {
    const at = tabs.findIndex((one) => one.id === id)
    change(id, undefined)
    if (active === id) active = tabs[Math.min(at, tabs.length - 1)]?.id ?? ''
  },
}

/** A query as an address has it. */
export const bare = (text: string) => text.trim().replace(/;$/, '')

/** `crypto.randomUUID` is not there for pages that are not encrypted. */
const newId = () => String(Math.random()).slice(2)

/** The first name that no other has. */
function nextName(): string {
  for (let number = 1; ; number += 1) {
    const name = `Query ${number}`
    if (!tabs.some((one) => one.name === name)) return name
  }
}
