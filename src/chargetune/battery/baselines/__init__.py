"""What charging controllers are compared with: charging protocols, and the comparison itself."""
