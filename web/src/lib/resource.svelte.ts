//! What a page asked for: the last answer stays on show while the next one is on its way, so nothing jumps.
import { ApiError, get } from './api'

export interface Resource<T> {
  readonly data: T | undefined
  readonly error: ApiError | undefined
  readonly loading: boolean
  retry(): void
}

/** Follows `href`; null asks for nothing. `asks` can replace the plain JSON request. */
export function resource<T>(href: () => string | null, asks: (href: string) => Promise<T> = get): Resource<T> {
  let data = $state.raw<T>()
  let error = $state.raw<ApiError>()
  let loading = $state(false)
  let turn = $state(0)
  $effect(() => {
    const wanted = href()
    void turn
    if (wanted === null) {
      data = undefined
      error = undefined
      loading = false
      return
    }
    let current = true
    loading = true
    asks(wanted).then(
      (answer) => {
        if (current) {
          data = answer
          error = undefined
          loading = false
        }
      },
      (reason: unknown) => {
        if (current) {
          error = reason instanceof ApiError ? reason : new ApiError(0, 'internal', String(reason), '')
          loading = false
        }
      },
    )
    return () => {
      current = false
    }
  })
  return {
    get data() {
      return data
    },
    get error() {
      return error
    },
    get loading() {
      return loading
    },
    retry: () => {
      turn += 1
    },
  }
}
