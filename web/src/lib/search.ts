//! The search part of addresses: parameters by name, any of which may be repeated.

/** New values by name; null or '' removes a parameter, a list repeats it. */
export type SearchChanges = Readonly<Record<string, string | number | null | readonly string[]>>

export const parseSearch = (search: string) => new URLSearchParams(search)

/** Builds an address of `path` with the parameters of `search`, some of them changed. */
export function changeSearch(path: string, search: string, changes: SearchChanges): string {
  const params = parseSearch(search)
  for (const [name, value] of Object.entries(changes)) {
    params.delete(name)
    if (Array.isArray(value)) for (const one of value) params.append(name, one)
    else if (value !== null && value !== '') params.set(name, String(value))
  }
  const text = params.toString().replaceAll('%2C', ',').replaceAll('%3A', ':').replaceAll('%2F', '/')
  return text ? `${path}?${text}` : path
}
