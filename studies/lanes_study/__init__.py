"""Lanes mapped by vehicles: paint by intensity and by camera, merged by the cloud, told as edits of a Lanelet2 map."""
