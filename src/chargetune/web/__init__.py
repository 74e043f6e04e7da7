"""A read-only live view of a store in the browser. starlette is imported when the application is made."""
