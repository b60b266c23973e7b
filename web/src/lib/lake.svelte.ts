//! The lake's facts, asked once for all pages.
import { apiHref, ApiError, get, type Lake } from './api'

let lake = $state.raw<Lake>()
let error = $state.raw<ApiError>()

export const theLake = {
  get value() {
    return lake
  },
  get error() {
    return error
  },
}

/** Asks for them. */
export function openLake(): void {
  error = undefined
  get<Lake>(apiHref('/lake')).then(
    (answer) => {
      lake = answer
    },
    (reason: unknown) => {
      error = reason as ApiError
    },
  )
}
