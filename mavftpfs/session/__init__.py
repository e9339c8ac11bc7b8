"""The one owner of the server session: pump, vehicle, scheduler, store."""
