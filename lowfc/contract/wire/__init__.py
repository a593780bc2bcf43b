"""Code that protoc generated from `lowfc/contract/proto`; `make proto` rewrites it."""
