"""W3C Web of Things: Thing Descriptions of robots and Roles, Thing Models of Roles, and the directory of Things."""
