"""The live workflow: a map that grows photo by photo (part D of the methods).

    accept (durable) -> place (metadata) -> draw -> link -> refine -> draw -> adjust blocks in the
    background

Start reading at `live_map.LiveMap`. `photo_intake` and `folder_watch` accept photos. `initial_pose`
and `drone_metadata` place them from their metadata. `neighbours`, `links`, `local_pose` and
`refinement` refine their poses from tie points. `redraw_queue` and `tile_drawing` keep the tiles up
to date. `adjustment_schedule`, `background_adjustment` and `apply_adjustment` adjust whole blocks
in the background. `final_map` runs the batch workflow at the end.
"""
